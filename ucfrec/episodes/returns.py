"""Returns-to-go, defined once for training, acting and scoring."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from ucfrec.arrays import Float32Array, Float64Array, IntArray

if TYPE_CHECKING:
    from torch import Tensor

Definition = Literal["session", "horizon"]


@dataclass(frozen=True)
class ReturnToGo:
    """What the return-to-go Ĝ_t of step t counts.

    - `session`: the whole rest of the session, Σ_{k≥t} r_k (paper section 2.1).
    - `horizon`: the next h steps, Σ_{t≤k<t+h} r_k.
    """

    definition: Definition = "session"
    horizon: Annotated[int, Field(ge=1)] = 1
    """h of `horizon`, steps."""

    @property
    def per_session(self) -> bool:
        """Whether a target is set for a session as a whole, so that rewards lower what is left;
        otherwise, the same target is set again at every step."""
        return self.definition == "session"

    def weights(self, ahead: IntArray) -> Float64Array:
        """Weights, of the shape of `ahead`, of rewards that come so many steps later."""
        reach = self.horizon if self.definition == "horizon" else np.inf
        return np.asarray(ahead < reach, dtype=np.float64)

    def of_logs(self, rewards: npt.NDArray[np.floating], offsets: IntArray) -> Float32Array:
        """Returns-to-go (N,) of logged episodes; summed in float64, rounded to float32.

        Example: rewards (N,) [1, 0, 2, 5] with offsets (E + 1,) [0, 3, 4], the first step of each
        episode and N, give [3, 2, 2, 5] for `session`.
        """
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
        else:
            sums = torch.nn.functional.pad(earlier.cumsum(1), (1, 0))  # before each step
            steps = torch.arange(length)
            ends = (steps + self.horizon).clamp(max=length)
            beyond = (steps + self.horizon - length).clamp(min=0).double() / self.horizon
            returns = sums[:, ends] - sums[:, :-1] + beyond.to(last) * last
        return torch.cat([returns, last], dim=1).float()
