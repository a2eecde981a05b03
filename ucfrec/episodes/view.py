"""Which episodes a view of a store has, and the values of their steps."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.columns import Columns
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Overlay
from ucfrec.errors import InputError

Array = npt.NDArray[Any]
IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]


class EpisodeView:
    """Some episodes of a store: E as they were logged and, after them, C edited copies.

    Arguments `episodes` are positions among those, 0 to E + C − 1.
    """

    def __init__(
        self, columns: Columns, episode_ids: IntArray | None = None, overlay: Overlay | None = None
    ) -> None:
        """Args:
        columns: what the store holds.
        episode_ids: (E,) numbers in the store of the view's episodes; None for all.
        overlay: edited copies.
        """
        self._columns, self._chosen = columns, episode_ids
        self.overlay = overlay
        """Edited copies of episodes, or None."""

    def __repr__(self) -> str:
        facts = [f"{self.n_steps:,} steps", f"{len(self.episode_ids):,} episodes"]
        if self.overlay is not None:
            facts[1] += f" and {len(self.overlay.copy_source):,} edited copies"
        if self.has_items and self._columns.knows_items:
            facts.append(f"{len(self.item_states.embeddings):,} items")
        facts.append(f"reward={self.meta['reward']}")
        splits = set() if self._chosen is None else set(self.episode_values(schema.SPLIT).tolist())
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
    def meta(self) -> Mapping[str, Any]:
        """Contents of `meta.json`."""
        return self._columns.meta

    @cached_property
    def episode_ids(self) -> IntArray:
        """(E,) numbers in the store of the view's episodes, copies not among them."""
        return np.arange(self.meta["n_episodes"]) if self._chosen is None else self._chosen

    @cached_property
    def _sources(self) -> IntArray:
        """(E + C,) number in the store of the episode behind every episode of the view."""
        if self.overlay is None:
            return self.episode_ids
        return np.concatenate([self.episode_ids, self.overlay.copy_source])

    @cached_property
    def lengths(self) -> IntArray:
        """(E + C,) steps of each episode."""
        return self._columns.lengths[self._sources]

    @property
    def n_episodes(self) -> int:
        """E + C: episodes of the view, copies among them."""
        return len(self._sources)

    @cached_property
    def n_steps(self) -> int:
        """Steps of the view, those of copies among them."""
        return int(self.lengths.sum())

    @property
    def has_items(self) -> bool:
        """Whether actions are items of a catalogue; otherwise they are vectors."""
        return self._columns.has_items

    @property
    def item_states(self) -> ItemStates:
        """How states are made of items (stores of items only)."""
        return self._columns.item_states

    @property
    def observation_size(self) -> int:
        """O, size of the logged observation; 0 where none was logged."""
        return self._columns.observation_size

    @property
    def state_size(self) -> int:
        """S."""
        return self.observation_size + (self.item_states.size if self.has_items else 0)

    def episode_values(self, name: str) -> Array:
        """One episode column, (E + C,); copies have their source's values."""
        return self._columns.of_episodes(name)[self._sources]

    @cached_property
    def returns(self) -> FloatArray:
        """(E + C,) return of each episode."""
        return self._columns.at(schema.RETURN_TO_GO, self._columns.starts[self._sources])

    def step_values(self, name: str, episodes: IntArray, steps: IntArray) -> Array:
        """One step column at the given steps of the given episodes.

        Args:
            episodes: positions in the view, of any shape.
            steps: of those episodes; a shape that broadcasts with the other.

        Returns:
            Values of the common shape, and the size of a vector after it.

        Raises:
            InputError: the store has no such column.
        """
        return self._columns.at(name, self._columns.starts[self._sources[episodes]] + steps)

    def all_steps(self) -> tuple[IntArray, IntArray]:
        """(episodes, steps), each (n_steps,), of every step of the view, in order."""
        episodes = np.repeat(np.arange(self.n_episodes), self.lengths)
        return episodes, np.arange(self.n_steps) - (self._ends - self.lengths)[episodes]

    @cached_property
    def _ends(self) -> IntArray:
        return np.cumsum(self.lengths)

    def draw_steps(self, generator: np.random.Generator, count: int) -> tuple[IntArray, IntArray]:
        """(episodes, steps), each (count,), drawn uniformly over the steps of the view."""
        return self.locate(generator.integers(self.n_steps, size=count))

    def locate(self, numbers: IntArray) -> tuple[IntArray, IntArray]:
        """(episodes, steps) of steps numbered 0 to n_steps − 1 through the view."""
        episodes = np.searchsorted(self._ends, numbers, side="right")
        return episodes, numbers - (self._ends[episodes] - self.lengths[episodes])

    def action_vectors(self, actions: Tensor) -> Tensor:
        """Actions as vectors (..., A): items (...) as their embeddings, vectors as they are."""
        return self.item_states.embeddings[actions] if self.has_items else actions

    def _require_steps(self, episodes: IntArray, ends: IntArray, length: int) -> None:
        if episodes.ndim != 1 or episodes.shape != ends.shape or length < 1:
            raise InputError(
                f"windows of {length} steps at episodes {episodes.shape} and steps {ends.shape}: "
                "give two arrays of the same length, and at least 1 step"
            )
        if len(episodes) == 0:
            return
        if not 0 <= episodes.min() <= episodes.max() < self.n_episodes:
            raise InputError(f"{self} has no episodes {episodes.min()} to {episodes.max()}")
        outside = (ends < 0) | (ends >= self.lengths[episodes])
        if outside.any():
            at = int(outside.argmax())
            raise InputError(
                f"episode {episodes[at]} has {self.lengths[episodes[at]]} steps, none numbered "
                f"{ends[at]}"
            )
