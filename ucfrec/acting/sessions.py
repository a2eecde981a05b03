"""Running sessions as arrays: what was shown so far, and the windows that a policy sees of it."""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.arrays import Float32Array, IntArray
from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Windows


@dataclass(frozen=True)
class Sessions:
    """B sessions of items, each before the step to decide."""

    items: Tensor
    """(B, L) int64 items shown, the latest last; −1 before the session began."""
    rewards: Tensor
    """(B, L) float32 their rewards, in reward units; 0 before the session began."""
    steps: Tensor
    """(B,) int64 number of items that the session has shown, which may be more than L."""
    collected: Tensor
    """(B,) float64 sum of all rewards of the session."""
    users: Tensor
    """(B,) int64 numbers of the users in the training logs, −1 for others."""
    observations: Tensor | None = None
    """(B, K, O) float32 of the last K steps or more, the one to decide included; None without
    any."""

    @classmethod
    def of_rows(
        cls,
        owner: IntArray,
        items: IntArray,
        rewards: Float32Array,
        users: IntArray,
        length: int,
        observations: Tensor | None = None,
    ) -> "Sessions":
        """The sessions with the given N rows.

        Args:
            owner: (N,) session of each row, 0 to B − 1; sorted.
            items: (N,) items shown, in order.
            rewards: (N,) their rewards.
            users: (B,) see above.
            length: L, items of a session that are kept.
            observations: (B, K, O) see above.
        """
        counts = np.bincount(owner, minlength=len(users))
        # Places from the end: the latest row is the last column.
        places = np.arange(len(owner)) - np.cumsum(counts)[owner] + length
        kept = places >= 0
        at = owner[kept], places[kept]
        shown = np.full((len(users), length), -1)
        received = np.zeros((len(users), length), dtype=np.float32)
        shown[at], received[at] = items[kept], rewards[kept]
        collected = np.bincount(owner, rewards, minlength=len(users)).astype(np.float64)
        return cls(
            torch.from_numpy(shown),
            torch.from_numpy(received),
            torch.from_numpy(counts),
            torch.from_numpy(collected),
            torch.from_numpy(users),
            observations,
        )

    def rows(self, numbers: Tensor) -> "Sessions":
        """The sessions with the given numbers (M,)."""
        values = (getattr(self, each.name) for each in fields(self))
        return Sessions(*(None if each is None else each[numbers] for each in values))  # type: ignore[arg-type]

    @cached_property
    def shown(self) -> Shown:
        """What was shown, the latest first."""
        return Shown(self.items.flip(1), self.rewards.flip(1))

    def windows(self, states: ItemStates, context: int) -> Windows:
        """Windows of `context` = K steps that end with the step to decide, whose returns-to-go are
        0.

        Args:
            states: builds the states; L must be at least K − 1 + its window.
            context: K.
        """
        window = states.window
        reach = context - 1 + window
        items, rewards = self.items[:, -reach:], self.rewards[:, -reach:]
        numbers = self.steps.unsqueeze(1) + torch.arange(1 - context, 1)
        mask, numbers = numbers >= 0, numbers.clamp(min=0)
        if self.observations is None:
            observations = rewards.new_zeros(items.shape[0], context, 0)
        else:
            observations = self.observations[:, -context:]
        built = states.of_sequences(items, rewards, numbers, self.users, observations)
        # The step to decide has neither an action nor a reward yet.
        actions = F.pad(items[:, window:].clamp(min=0), (0, 1))
        return Windows(
            states=built.masked_fill(~mask.unsqueeze(-1), 0.0),
            actions=actions,
            rewards=F.pad(rewards[:, window:], (0, 1)),
            returns_to_go=torch.zeros_like(actions, dtype=torch.float32),
            timesteps=numbers,
            mask=mask,
        )
