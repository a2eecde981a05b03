"""Item-embedding states: what a session looked like just before step t.

Training windows and acting call the same `ItemStates.build`, made of element-wise operations in a
fixed order only, so both give the same bits whatever the batch.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, save_tensors

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class ItemStates:
    """How states are made of items shown, rewards earned and features of the user.

    A state of size S = 3D + 2 + F + O holds, in this order: the recency-weighted mean embedding of
    the last `window` items shown (D), the same weighted by reward as well (D), the last item's
    embedding (D), the last reward scaled to [0, 1] (1), log(1 + step) (1), user features (F) and
    the logged observation (O), where it has any numbers.
    """

    embeddings: Tensor
    """(n_items, D)."""
    user_features: Tensor
    """(n_users, F), standardised; F is 0 where none were given."""
    reward_low: float
    """Reward that is scaled to 0, as are lower ones."""
    reward_high: float
    """Reward that is scaled to 1, as are higher ones."""
    window: int = 10
    decay: float = 0.8

    def __post_init__(self) -> None:
        if not self.reward_low < self.reward_high:
            raise InputError(
                f"rewards from {self.reward_low:g} to {self.reward_high:g} have no scale; "
                "reward_low must be below reward_high"
            )
        # Row −1 stands for "no item" and "unknown user": all zeros.
        object.__setattr__(self, "_items", _with_zero_row(self.embeddings))
        object.__setattr__(self, "_users", _with_zero_row(self.user_features))

    @property
    def size(self) -> int:
        """Size of a state without an observation, 3D + 2 + F."""
        return 3 * self.embeddings.shape[1] + 2 + self.user_features.shape[1]

    def build(
        self, items: Tensor, rewards: Tensor, steps: Tensor, users: Tensor, observations: Tensor
    ) -> Tensor:
        """States before the steps `steps`.

        Args:
            items: (..., window) int64, most recent first, −1 where the session had not begun.
            rewards: (..., window) rewards of those items.
            steps: (...) int64, number of the step in its session, from 0.
            users: (...) int64 rows of `user_features`, −1 for a user never seen.
            observations: (..., O) logged with the step; O may be 0.

        Returns:
            (..., S) float32.
        """
        table: Tensor = self._items  # type: ignore[attr-defined]
        liking = ((rewards - self.reward_low) / (self.reward_high - self.reward_low)).clamp(0, 1)
        valid = (items >= 0).float()
        shown = torch.zeros(*items.shape[:-1], table.shape[1])
        liked, shown_weight, liked_weight = shown.clone(), valid[..., 0] * 0, valid[..., 0] * 0
        for back in range(self.window):
            embedding = table[items[..., back]]
            weight = valid[..., back] * self.decay**back
            shown = shown + weight.unsqueeze(-1) * embedding
            shown_weight = shown_weight + weight
            weight = weight * liking[..., back]
            liked = liked + weight.unsqueeze(-1) * embedding
            liked_weight = liked_weight + weight
        return torch.cat(
            [
                shown / shown_weight.clamp(min=1e-6).unsqueeze(-1),
                liked / liked_weight.clamp(min=1e-6).unsqueeze(-1),
                table[items[..., 0]],
                (liking[..., 0] * valid[..., 0]).unsqueeze(-1),
                torch.log1p(steps.float()).unsqueeze(-1),
                self._users[users],  # type: ignore[attr-defined]
                observations,
            ],
            dim=-1,
        )

    def save(self, path: Path) -> None:
        """Write to one safetensors file."""
        numbers = {"window": self.window, "decay": self.decay}
        numbers |= {"reward_low": self.reward_low, "reward_high": self.reward_high}
        tensors = {"embeddings": self.embeddings, "user_features": self.user_features}
        save_tensors(path, tensors, numbers)

    @classmethod
    def load(cls, path: Path) -> "ItemStates":
        """Read what `save` wrote."""
        tensors, numbers = load_tensors(path)
        return cls(tensors["embeddings"], tensors["user_features"], **numbers)


def _with_zero_row(table: Tensor) -> Tensor:
    return torch.cat([table.float(), torch.zeros(1, table.shape[1])])


class SessionStates:
    """States of N sessions under way, kept up to date one step at a time."""

    def __init__(self, states: ItemStates, sessions: int) -> None:
        self._states = states
        self._items = torch.full((sessions, states.window), -1, dtype=torch.int64)
        self._rewards = torch.zeros(sessions, states.window)
        self._steps = torch.zeros(sessions, dtype=torch.int64)
        self.users = torch.full((sessions,), -1, dtype=torch.int64)
        """(N,) rows of the user table; −1, the default, for a user never seen."""

    def begin(self, rows: IntArray) -> None:
        """The sessions in `rows` start afresh."""
        self._items[rows] = -1
        self._rewards[rows] = 0.0
        self._steps[rows] = 0

    def current(self, observations: Tensor) -> Tensor:
        """(N, S) states before the next step, given (N, O) observations."""
        return self._states.build(self._items, self._rewards, self._steps, self.users, observations)

    def record(self, items: Tensor, rewards: Tensor) -> None:
        """Take note of the items (N,) just shown and the rewards (N,) they earned."""
        rewards = rewards.float()  # as the store holds them
        self._items = torch.cat([items.unsqueeze(1), self._items[:, :-1]], dim=1)
        self._rewards = torch.cat([rewards.unsqueeze(1), self._rewards[:, :-1]], dim=1)
        self._steps += 1
