"""What is known of sessions before a step to decide, whether logged, requested or simulated."""

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
class Sessions:
    """B sessions, each before the step to decide."""

    actions: Tensor
    """(B, L) int64 items shown, the latest last, −1 before the session began; or (B, L, A) float32
    vectors."""
    rewards: Tensor
    """(B, L) float32 their rewards, in reward units; 0 before the session began."""
    steps: Tensor
    """(B,) int64 number of steps that the session has had, which may be more than L."""
    collected: Tensor
    """(B,) float64 sum of all rewards of the session."""
    users: Tensor
    """(B,) int64 numbers of the users in the training logs, −1 for others."""
    observations: Tensor | None = None
    """(B, K, O) float32 of the last K steps or more, the one to decide included; None without
    any."""
    states: Tensor | None = None
    """(B, K, S) float32 of the last K steps or more, where they are known; None to build them."""

    @classmethod
    def begun(cls, count: int, length: int, vector_size: int = 0) -> "Sessions":
        """Sessions of unknown users without a step.

        Args:
            count: B.
            length: L.
            vector_size: A; 0 for items.
        """
        actions = torch.full((count, length), -1)
        if vector_size:
            actions = torch.zeros(count, length, vector_size)
        steps = torch.zeros(count, dtype=torch.int64)
        return cls(actions, torch.zeros(count, length), steps, steps.double(), steps - 1)

    @classmethod
    def from_rows(
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
        recent = places >= 0
        at = owner[recent], places[recent]
        recent_items = np.full((len(users), length), -1)
        received = np.zeros((len(users), length), dtype=np.float32)
        recent_items[at], received[at] = items[recent], rewards[recent]
        collected = np.bincount(owner, rewards, minlength=len(users)).astype(np.float64)
        return cls(
            torch.from_numpy(recent_items),
            torch.from_numpy(received),
            torch.from_numpy(counts),
            torch.from_numpy(collected),
            torch.from_numpy(users),
            observations,
        )

    @classmethod
    def from_store(
        cls, store: EpisodeStore, episodes: IntArray, steps: IntArray, context: int, length: int
    ) -> "Sessions":
        """What was known before steps of a store of items.

        Args:
            store: the logs, with the training's items. An item −1 is unknown; any known item can
                replace it, because steps after it have weight 0 in all estimates.
            episodes: (B,) sessions.
            steps: (B,) steps of those sessions, from 0.
            context: K, most states that are read.
            length: L, items that are read one by one; as many as the context has in any case.
        """
        context = min(context, int(steps.max(initial=0)) + 1)
        recent = Shown.before(store, episodes, steps, max(length, context - 1))
        users = np.full(len(steps), -1)
        if store.has_users:
            users = store.episode_values(schema.USER).astype(np.int64)[episodes]
        return cls(
            recent.items.flip(1),
            recent.rewards.flip(1),
            torch.from_numpy(steps),
            torch.from_numpy(store.rewards_before(episodes, steps)),
            torch.from_numpy(users),
            states=store.windows(episodes, steps, context).states,
        )

    def at(self, rows: slice | IntArray | Tensor) -> "Sessions":
        """The sessions with the given numbers."""
        values = (getattr(self, part.name) for part in fields(self))
        return Sessions(*(None if value is None else value[rows] for value in values))  # type: ignore[arg-type]

    def begin(self, rows: IntArray) -> None:
        """Let new sessions begin at the positions `rows`, of whichever users there are."""
        self.actions[rows] = -1
        for values in (self.rewards, self.steps, self.collected):
            values[rows] = 0

    def with_step(self, actions: Tensor, rewards: Tensor) -> "Sessions":
        """The sessions after one more step: actions (B,) or (B, A), and their rewards (B,)."""
        received = rewards.float()  # rounded like the store's, for bit-identical states
        return replace(
            self,
            actions=torch.cat([self.actions[:, 1:], actions.unsqueeze(1)], dim=1),
            rewards=torch.cat([self.rewards[:, 1:], received.unsqueeze(1)], dim=1),
            steps=self.steps + 1,
            collected=self.collected + received,
        )

    @cached_property
    def shown(self) -> Shown:
        """The items shown, the latest first."""
        return Shown(self.actions.flip(1), self.rewards.flip(1))

    def latest_states(self, states: ItemStates, observations: Tensor) -> Tensor:
        """States (B, S) before the steps to decide, whose observations are (B, O)."""
        recent = self.actions[:, -states.window :], self.rewards[:, -states.window :]
        steps = self.steps.unsqueeze(1)
        return states.build(*recent, steps, self.users, observations.unsqueeze(1))[:, 0]

    def windows(self, states: ItemStates | None, context: int) -> Windows:
        """What policies read: windows of at most `context` = K steps that end with the step to
        decide, which has neither an action nor a reward yet, nor returns-to-go.

        Args:
            states: builds the states of items, where they are not known; L must then be at least
                K − 1 + its window.
            context: K; L must be at least K − 1.
        """
        vectors = self.actions.ndim == 3
        if not (vectors or torch.compiler.is_exporting()):
            # No policy's outputs depend on how much padding is before a session.
            context = min(context, int(self.steps.max()) + 1)
        numbers = self.steps.unsqueeze(1) + torch.arange(1 - context, 1)
        if self.states is None:
            assert states is not None
            window_states = self._build_states(states, numbers.clamp(min=0))
        else:
            window_states = self.states[:, -context:]
        first = self.actions.shape[1] - context + 1
        return Windows.of(
            numbers,
            window_states,
            F.pad(self.actions[:, first:], (0, 0, 0, 1) if vectors else (0, 1)),
            F.pad(self.rewards[:, first:], (0, 1)),
        )

    def _build_states(self, states: ItemStates, steps: Tensor) -> Tensor:
        """States (B, K, S) of steps (B, K), the last ones."""
        context = steps.shape[1]
        reach = context - 1 + states.window
        items, rewards = self.actions[:, -reach:], self.rewards[:, -reach:]
        if self.observations is None:
            observations = rewards.new_zeros(items.shape[0], context, 0)
        else:
            observations = self.observations[:, -context:]
        return states.build(items, rewards, steps, self.users, observations)


def seen_before(store: EpisodeStore, episodes: IntArray, steps: IntArray) -> Tensor:
    """(B, n_items) bool: the known items that sessions (B,) showed before steps (B,)."""
    rows, items = store.items_before(episodes, steps)
    seen = torch.zeros(len(steps), len(store.item_states.embeddings), dtype=torch.bool)
    seen[torch.from_numpy(rows[items >= 0]), torch.from_numpy(items[items >= 0])] = True
    return seen
