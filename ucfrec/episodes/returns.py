"""Returns-to-go, defined once for both training and acting."""

from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

ArrayOrTensor = TypeVar("ArrayOrTensor", npt.NDArray[np.float64], "Tensor")


def remaining_return(total: ArrayOrTensor, collected: ArrayOrTensor) -> ArrayOrTensor:
    """The return-to-go: `total` minus the rewards collected so far (undiscounted, γ = 1).

    Args:
        total: the episode's return in training, the target return when acting; any shape.
        collected: sum of the rewards strictly before the step, of the same shape.
    """
    return total - collected


def returns_to_go(
    rewards: npt.NDArray[np.floating], offsets: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Undiscounted suffix sums Ĝ_t = Σ_{k≥t} r_k within each episode (paper section 2.1).

    Example: rewards [1, 0, 2, 5] with offsets [0, 3, 4] give [3, 2, 2, 5].

    Args:
        rewards: (N,) rewards of all episodes, concatenated.
        offsets: (E + 1,) index of the first step of each episode, followed by N.

    Returns:
        (N,) returns-to-go in reward units; summed in float64, rounded to float32.
    """
    lengths = np.diff(offsets)
    before = np.concatenate([[0.0], np.cumsum(rewards, dtype=np.float64)])  # (N + 1,)
    totals = before[offsets[1:]] - before[offsets[:-1]]  # (E,)
    collected = before[:-1] - np.repeat(before[offsets[:-1]], lengths)  # (N,)
    remaining: npt.NDArray[np.float32] = remaining_return(
        np.repeat(totals, lengths), collected
    ).astype(np.float32)
    return remaining
