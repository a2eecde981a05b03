"""Returns-to-go, defined once for training, acting and scoring."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from ucfrec.arrays import Float32Array, Float64Array, IntArray

if TYPE_CHECKING:
    from torch import Tensor

Definition = Literal["session", "discounted", "horizon"]


@dataclass(frozen=True)
class ReturnToGo:
    """What the return-to-go Ĝ_t of step t counts.

    - `session`: the whole rest of the session, Σ_{k≥t} r_k (paper section 2.1).
    - `discounted`: Σ_{k≥t} γ^{k−t} r_k.
    - `horizon`: the next h steps, Σ_{t≤k<t+h} r_k.
    """

    definition: Definition = "session"
    discount: Annotated[float, Field(gt=0, le=1)] = 0.9
    """γ of `discounted`."""
    horizon: Annotated[int, Field(ge=1)] = 1
    """h of `horizon`, steps."""

    @property
    def per_session(self) -> bool:
        """Whether a target is set for a session as a whole, so that rewards lower what is left;
        otherwise, the same target is set again at every step."""
        return self.definition == "session"

    def weights(self, ahead: IntArray) -> Float64Array:
        """How much of a reward counts that comes this number of steps later, of the shape of
        `ahead`."""
        if self.definition == "discounted":
            return np.asarray(self.discount**ahead, dtype=np.float64)
        reach = self.horizon if self.definition == "horizon" else np.inf
        return np.asarray(ahead < reach, dtype=np.float64)

    def of_logs(self, rewards: npt.NDArray[np.floating], offsets: IntArray) -> Float32Array:
        """Returns-to-go (N,) of logged episodes; summed in float64, rounded to float32.

        Example: rewards (N,) [1, 0, 2, 5] with offsets (E + 1,) [0, 3, 4], the first step of each
        episode and N, give [3, 2, 2, 5] for `session`.
        """
        if self.definition == "discounted":
            return _discount(rewards, offsets, self.discount)
        sums = np.concatenate([[0.0], np.cumsum(rewards, dtype=np.float64)])  # (N + 1,)
        lengths, steps = np.diff(offsets), np.arange(len(rewards))
        ends = np.repeat(offsets[1:], lengths)
        if self.definition == "horizon":
            reached = np.minimum(steps + self.horizon, ends)
            return np.asarray(sums[reached] - sums[:-1], dtype=np.float32)
        starts = np.repeat(offsets[:-1], lengths)
        totals, collected = sums[ends] - sums[starts], sums[:-1] - sums[starts]
        return np.asarray(totals - collected, dtype=np.float32)

    def target_returns(self, target: float, collected: "Tensor") -> "Tensor":
        """Target returns (B,) float64 at the next step, in reward units, of a `target` of the
        session if `per_session`, otherwise of every step; `collected` (B,) before it."""
        import torch  # checking a log needs this module, but not the seconds that importing takes

        whole = torch.full_like(collected, target, dtype=torch.float64)
        return whole - collected if self.per_session else whole

    def before(self, targets: "Tensor", rewards: "Tensor") -> "Tensor":
        """Returns-to-go (B, K) float32 of windows with target returns (B,) at their last steps.

        Earlier steps count the rewards that followed them, then the target return: the numbers that
        training would show if the rest of the session returned exactly that. The last column of the
        rewards (B, K), 0 at padding, is not used.
        """
        import torch

        earlier, last = rewards[:, :-1].double(), targets.double().unsqueeze(1)
        length = earlier.shape[1]
        if self.definition == "session":
            returns = last + earlier.flip(1).cumsum(1).flip(1)
        elif self.definition == "discounted":
            # Σ_{j≤k<t} γ^{k−j} r_k: a triangular product, because a recursion would be a loop.
            ahead = torch.arange(length).unsqueeze(0) - torch.arange(length).unsqueeze(1)
            weights = torch.where(ahead >= 0, self.discount ** ahead.clamp(min=0).double(), 0.0)
            reach = self.discount ** torch.arange(length, 0, -1, dtype=torch.float64)
            returns = earlier @ weights.T.to(earlier) + reach.to(last) * last
        else:
            sums = torch.nn.functional.pad(earlier.cumsum(1), (1, 0))  # before each step
            steps = torch.arange(length)
            ends = (steps + self.horizon).clamp(max=length)
            beyond = (steps + self.horizon - length).clamp(min=0).double() / self.horizon
            returns = sums[:, ends] - sums[:, :-1] + beyond.to(last) * last
        return torch.cat([returns, last], dim=1).float()


def _discount(
    rewards: npt.NDArray[np.floating], offsets: IntArray, discount: float
) -> Float32Array:
    """Discounted suffix sums, for all episodes at once, one step from their ends at a time."""
    lengths = np.diff(offsets)
    order = np.argsort(-lengths, kind="stable")
    longest, result = int(lengths.max(initial=0)), np.zeros(len(rewards))
    reached = np.searchsorted(-lengths[order], -np.arange(1, longest + 1), side="right")
    following = np.zeros(len(lengths))
    for back in range(1, longest + 1):
        rows = order[: reached[back - 1]]
        steps = offsets[1:][rows] - back
        following[rows] = rewards[steps] + discount * following[rows]
        result[steps] = following[rows]
    return result.astype(np.float32)
