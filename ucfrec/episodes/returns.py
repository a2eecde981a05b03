"""Returns-to-go: one definition for training windows and for acting."""

from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

ArrayOrTensor = TypeVar("ArrayOrTensor", npt.NDArray[np.float64], "Tensor")


def remaining_return(total: ArrayOrTensor, earned: ArrayOrTensor) -> ArrayOrTensor:
    """What is left of `total` once `earned` has been collected (undiscounted, γ = 1).

    In training, `total` is the episode's return; when acting, it is the target return. Both have
    the same shape, any; `earned` sums the rewards strictly before the step.
    """
    return total - earned


def returns_to_go(
    rewards: npt.NDArray[np.floating], offsets: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Undiscounted suffix sums Ĝ_t = Σ_{k≥t} r_k within each episode (paper section 2.1).

    Example: rewards [1, 0, 2, 5] with offsets [0, 3, 4] give [3, 2, 2, 5].

    Args:
        rewards: (N,) rewards of all episodes, one after the other.
        offsets: (E + 1,) first step of each episode, then N.

    Returns:
        (N,) returns-to-go.
    """
    lengths = np.diff(offsets)
    before = np.concatenate([[0.0], np.cumsum(rewards, dtype=np.float64)])  # (N + 1,)
    totals = before[offsets[1:]] - before[offsets[:-1]]  # (E,)
    earned = before[:-1] - np.repeat(before[offsets[:-1]], lengths)  # (N,)
    remaining: npt.NDArray[np.float32] = remaining_return(
        np.repeat(totals, lengths), earned
    ).astype(np.float32)
    return remaining
