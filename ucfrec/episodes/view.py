"""Views of a store: the episodes of a view, and access to their columns."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.columns import Columns
from ucfrec.episodes.record import StoreRecord
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Transitions, Windows
from ucfrec.errors import InputError

_BATCH_STEPS = 2**20
_LONG_ENOUGH = 1000
"""Mean number of steps from which consecutive steps are read as slices."""


class EpisodeView:
    """E episodes of a store. Wherever a method takes `episodes`, these are positions in the view,
    0 to E − 1."""

    def __init__(self, columns: Columns, episode_ids: IntArray | None = None) -> None:
        """
        Args:
            episode_ids: (E,) numbers in the store of the view's episodes; None for all.
        """
        self._columns, self._selected = columns, episode_ids

    def __repr__(self) -> str:
        facts = [f"{self.n_steps:,} steps", f"{len(self):,} episodes"]
        if self.has_items and self._columns.has_item_states:
            facts.append(f"{len(self.item_states.embeddings):,} items")
        facts.append(f"reward={self.record.reward}")
        splits = (
            set() if self._selected is None else set(self.episode_values(schema.SPLIT).tolist())
        )
        if len(splits) == 1:
            facts.append(f"split={schema.SPLITS[splits.pop()]}")
        return f"{type(self).__name__}({', '.join(facts)})"

    def __len__(self) -> int:
        return self.n_episodes

    @property
    def path(self) -> Path:
        """The store folder."""
        return self._columns.path

    @property
    def record(self) -> StoreRecord:
        """The content of `meta.json`."""
        return self._columns.record

    @property
    def return_to_go(self) -> ReturnToGo:
        """What the returns-to-go count."""
        return self._columns.return_to_go

    @cached_property
    def episode_ids(self) -> IntArray:
        """(E,) numbers in the store of the episodes of the view."""
        return np.arange(self.record.n_episodes) if self._selected is None else self._selected

    @cached_property
    def lengths(self) -> IntArray:
        """(E,) number of steps of each episode."""
        return self._columns.lengths[self.episode_ids]

    @property
    def n_episodes(self) -> int:
        """E, the number of episodes of the view."""
        return len(self.episode_ids)

    @cached_property
    def n_steps(self) -> int:
        """Number of steps of the view."""
        return int(self._counts.sum())

    @cached_property
    def _counts(self) -> IntArray:
        """(E,) number of steps of each episode that count, which are its last."""
        if self._columns.skipped is None:
            return self.lengths
        return self.lengths - self._columns.skipped[self.episode_ids]

    @cached_property
    def has_items(self) -> bool:
        """Whether actions are items of a catalogue; otherwise they are vectors."""
        return self._columns.has_items

    @property
    def has_users(self) -> bool:
        """Whether the store names the user of every episode."""
        return self.has_episode_values(schema.USER)

    @property
    def item_states(self) -> ItemStates:
        """Builds states from items; for stores of items only.

        Raises:
            InputError: the file of item states is missing or damaged.
        """
        return self._columns.item_states

    @cached_property
    def observation_size(self) -> int:
        """O, size of the logged observation; 0 if none was logged."""
        return self._columns.observation_size

    @property
    def state_size(self) -> int:
        """S, size of a state: that of the item state, if actions are items, plus O."""
        return self.observation_size + (self.item_states.size if self.has_items else 0)

    def has_episode_values(self, name: str) -> bool:
        """Whether the store has an episode column."""
        return self._columns.has_episode_column(name)

    def episode_values(self, name: str) -> Array:
        """An episode column, (E,).

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        return self._columns.episode_column(name)[self.episode_ids]

    @property
    def terminated(self) -> BoolArray:
        """(E,) whether each session is known to have ended with its last step."""
        if not self.has_episode_values(schema.TERMINATED):
            return np.ones(self.n_episodes, dtype=bool)
        return self.episode_values(schema.TERMINATED).astype(bool)

    @cached_property
    def returns(self) -> Float32Array:
        """(E,) undiscounted return of each episode, in reward units."""
        episodes = np.arange(self.n_episodes)
        return self.step_values(schema.RETURN_TO_GO, episodes, np.zeros_like(episodes))

    def step_values(self, name: str, episodes: IntArray, steps: IntArray) -> Array:
        """Values of a step column at the given steps.

        Args:
            episodes: positions in the view, of any shape.
            steps: steps of those episodes, from 0, of a shape that broadcasts with `episodes`.

        Returns:
            Values of the broadcast shape, followed by the size of a vector.

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        index = self._columns.starts[self.episode_ids[episodes]] + steps
        return self._columns.step_values(index, name)[0]

    def rewards_before(self, episodes: IntArray, steps: IntArray) -> Float64Array:
        """(B,) sum of the rewards of the session before each step, in reward units.

        Args:
            episodes: (B,) positions in the view.
            steps: (B,) steps of those episodes, from 0.
        """
        owner, earlier_steps = self._earlier(steps)
        rewards = self.step_values(schema.REWARD, episodes[owner], earlier_steps)
        return np.bincount(owner, rewards, minlength=len(steps)).astype(np.float64)

    def items_before(self, episodes: IntArray, steps: IntArray) -> tuple[IntArray, IntArray]:
        """(rows, items), each (M,): the items that sessions showed before the given steps.

        Args:
            episodes: (B,) positions in the view.
            steps: (B,) steps of those episodes, from 0; `rows` are indices into the B.
        """
        owner, earlier_steps = self._earlier(steps)
        return owner, self.step_values(schema.ITEM, episodes[owner], earlier_steps).astype(np.int64)

    @staticmethod
    def _earlier(steps: IntArray) -> tuple[IntArray, IntArray]:
        """Row and number of every step before the given ones (B,), row by row."""
        owner = np.repeat(np.arange(len(steps)), steps)
        return owner, np.arange(len(owner)) - np.repeat(np.cumsum(steps) - steps, steps)

    def all_steps(self) -> tuple[IntArray, IntArray]:
        """(episodes, steps), each (n_steps,): every step of the view, episode by episode."""
        episodes = np.repeat(np.arange(self.n_episodes), self._counts)
        return episodes, np.arange(self.n_steps) - (self._ends - self.lengths)[episodes]

    def step_batches(self) -> Iterator[tuple[IntArray, IntArray]]:
        """`all_steps` in batches, for views whose steps are too many to list."""
        for begin in range(0, self.n_steps, _BATCH_STEPS):
            end = min(begin + _BATCH_STEPS, self.n_steps)
            first, last = np.searchsorted(self._ends, (begin, end - 1), side="right")
            counts = np.diff(self._ends[first : last + 1].clip(max=end), prepend=begin)
            episodes = np.repeat(np.arange(first, last + 1), counts)
            starts = self._ends[episodes] - self.lengths[episodes]
            yield episodes, np.arange(begin, end) - starts

    def column(self, name: str) -> Array:
        """The values of a step column at `all_steps`, (n_steps,) or (n_steps, size).

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        parts = [part for (part,) in self.column_batches(name)]
        return np.concatenate(parts) if parts else self.step_values(name, *self.all_steps())

    def column_batches(self, *names: str) -> Iterator[tuple[Array, ...]]:
        """Step columns at `all_steps`, some steps at a time.

        Raises:
            InputError: the store has no such column, or its files are damaged.
        """
        if not self.n_steps:
            return
        ends = (self._columns.starts + self._columns.lengths)[self.episode_ids]
        begins = ends - self._counts
        apart = begins[1:] != ends[:-1]
        begins, ends = begins[np.append(True, apart)], ends[np.append(apart, True)]
        if len(begins) > self.n_steps // _LONG_ENOUGH:
            for steps in self.step_batches():
                yield tuple(self.step_values(name, *steps) for name in names)
            return
        for begin, end in zip(begins, ends, strict=True):
            for first in range(begin, end, _BATCH_STEPS):
                last = min(first + _BATCH_STEPS, end)
                yield tuple(self._columns.step_range(name, first, last) for name in names)

    def item_counts(self) -> IntArray:
        """(n_items,) number of steps of the view that show each item; for stores of items only."""
        counts = np.zeros(len(self.item_states.embeddings), dtype=np.int64)
        for (items,) in self.column_batches(schema.ITEM):
            counts += np.bincount(items, minlength=len(counts))
        return counts

    @cached_property
    def _ends(self) -> IntArray:
        return np.cumsum(self._counts)

    def draw_steps(self, generator: np.random.Generator, count: int) -> tuple[IntArray, IntArray]:
        """(episodes, steps), each (count,): steps drawn uniformly, with replacement."""
        return self.locate(generator.integers(self.n_steps, size=count))

    def locate(self, numbers: IntArray) -> tuple[IntArray, IntArray]:
        """(episodes, steps) of the steps with the given indices in `all_steps`, of any shape."""
        episodes = np.searchsorted(self._ends, numbers, side="right")
        return episodes, numbers - (self._ends[episodes] - self.lengths[episodes])

    def action_vectors(self, actions: Tensor) -> Tensor:
        """Actions as vectors (..., A): the embeddings of items (...); vectors are unchanged."""
        return self.item_states.embeddings[actions] if self.has_items else actions

    def windows(self, episodes: IntArray, ends: IntArray, length: int) -> Windows:
        """Windows of `length` steps that end with step `ends[b]` (inclusive) of `episodes[b]`.

        Example: for an episode with rewards [5, 6, 7, 8], end 1 and length 3 give rewards
        [0, 5, 6], mask [false, true, true] and timesteps [0, 0, 1].

        Args:
            episodes: (B,) positions in the view.
            ends: (B,) last step of each window, from 0.
            length: K, at least 1.

        Returns:
            B windows of K steps, padded on the left.

        Raises:
            InputError: an episode or step does not exist, or the arguments have other shapes.
        """
        self._require_steps(episodes, ends, length)
        steps = ends[:, None] + np.arange(1 - length, 1)  # (B, K)
        action = schema.ITEM if self.has_items else schema.ACTION
        names = action, schema.REWARD, schema.RETURN_TO_GO
        numbers = self.episode_ids[episodes]
        index = self._columns.starts[numbers][:, None] + np.maximum(steps, 0)
        columns = self._columns.step_values(index, *names)
        actions, rewards, returns_to_go = map(torch.from_numpy, columns)
        return Windows.of(
            torch.from_numpy(steps),
            self._columns.states(numbers, steps),
            actions.long() if self.has_items else actions,
            rewards,
            returns_to_go,
        )

    def transitions(self, episodes: IntArray, steps: IntArray) -> Transitions:
        """Single steps with their next states.

        Args:
            episodes: (M,) positions in the view.
            steps: (M,) steps of those episodes, from 0.

        Raises:
            InputError: an episode or step does not exist, or the arguments have other shapes.
        """
        window = self.windows(episodes, steps, 1)
        last = steps == self.lengths[episodes] - 1
        next_steps = np.where(last, steps, steps + 1)
        next_states = self._columns.states(self.episode_ids[episodes], next_steps[:, None])[:, 0]
        is_last = torch.from_numpy(last)
        return Transitions(
            states=window.states[:, 0],
            actions=self.action_vectors(window.actions[:, 0]),
            rewards=window.rewards[:, 0],
            next_states=next_states.masked_fill(is_last.unsqueeze(-1), 0.0),
            last=is_last,
        )

    def _require_steps(self, episodes: IntArray, ends: IntArray, length: int) -> None:
        if episodes.ndim != 1 or episodes.shape != ends.shape or length < 1:
            raise InputError(
                f"windows of {length} steps, episodes of shape {episodes.shape} and steps of shape "
                f"{ends.shape}: give two arrays of the same length, and at least 1 step"
            )
        if len(episodes) == 0:
            return
        if not 0 <= episodes.min() <= episodes.max() < self.n_episodes:
            raise InputError(
                f"{self} has no episodes {episodes.min()} to {episodes.max()}; give positions from "
                f"0 to {self.n_episodes - 1}"
            )
        outside = (ends < 0) | (ends >= self.lengths[episodes])
        if outside.any():
            first = int(outside.argmax())
            raise InputError(
                f"episode {episodes[first]} has {self.lengths[episodes[first]]} steps, none "
                f"numbered {ends[first]}; steps are numbered from 0"
            )
