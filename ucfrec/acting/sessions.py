"""What is known of sessions before a step to decide: as arrays, and as a scorer reads it."""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import Float32Array, IntArray
from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows


@dataclass(frozen=True)
class History:
    """What is known of B sessions before the steps to decide; see `Scorer.scores`."""

    windows: Windows
    """Windows that end with the step to decide; its action and reward are not read."""
    collected: Tensor
    """(B,) float64 rewards earlier in the session, also before the window."""
    users: Tensor
    """(B,) int64 numbers of the users in the training logs, −1 for others."""
    shown: Shown
    """The items shown before, as far back as the scorer reads them."""

    @classmethod
    def logged(
        cls, store: EpisodeStore, episodes: IntArray, steps: IntArray, context: int, reach: int
    ) -> "History":
        """What was known before steps of a store of items.

        Args:
            store: the logs, with the training's items. An item −1 is unknown; any known item can
                replace it, because steps after it have weight 0 in all estimates.
            episodes: (B,) sessions.
            steps: (B,) steps of those sessions, from 0.
            context: K, most steps of a window.
        """
        context = min(context, int(steps.max(initial=0)) + 1)
        windows = store.windows(episodes, steps, context)
        users = np.full(len(steps), -1)
        if store.has_users:
            users = store.episode_values(schema.USER).astype(np.int64)[episodes]
        return cls(
            replace(windows, actions=windows.actions.clamp(min=0)),
            torch.from_numpy(store.rewards_before(episodes, steps)),
            torch.from_numpy(users),
            Shown.before(store, episodes, steps, reach),
        )

    def at(self, rows: slice | Tensor) -> "History":
        """The sessions with the given numbers."""
        parts = self.windows.at(rows), self.collected[rows], self.users[rows]
        return History(*parts, self.shown.at(rows))


def seen_before(store: EpisodeStore, episodes: IntArray, steps: IntArray) -> Tensor:
    """(B, n_items) bool: the known items that sessions (B,) showed before steps (B,)."""
    rows, items = store.items_before(episodes, steps)
    seen = torch.zeros(len(steps), len(store.item_states.embeddings), dtype=torch.bool)
    seen[torch.from_numpy(rows[items >= 0]), torch.from_numpy(items[items >= 0])] = True
    return seen


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

    def history(self, states: ItemStates, context: int) -> History:
        """What is known of the sessions, in windows of at most `context` = K steps.

        Args:
            states: builds the states; L must be at least K − 1 + its window.
            context: K.
        """
        if not torch.compiler.is_exporting():
            # No policy's outputs depend on how much padding is before a session.
            context = min(context, int(self.steps.max()) + 1)
        window = states.window
        reach = context - 1 + window
        items, rewards = self.items[:, -reach:], self.rewards[:, -reach:]
        numbers = self.steps.unsqueeze(1) + torch.arange(1 - context, 1)
        if self.observations is None:
            observations = rewards.new_zeros(items.shape[0], context, 0)
        else:
            observations = self.observations[:, -context:]
        places = numbers.clamp(min=0)
        windows = Windows.of(
            numbers,
            states.of_sequences(items, rewards, places, self.users, observations),
            # The step to decide has neither an action nor a reward yet.
            F.pad(items[:, window:], (0, 1)),
            F.pad(rewards[:, window:], (0, 1)),
        )
        return History(windows, self.collected, self.users, self.shown)
