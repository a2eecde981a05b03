"""EpisodeStore: memory-mapped episodes, gathered as windows or single transitions."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.episodes.item_table import ITEM_STATES
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.view import Columns, EpisodeView, StepColumn
from ucfrec.episodes.writer import require_finite, require_steps, write_arrays
from ucfrec.errors import InputError
from ucfrec.files.parquet import read_ids

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["ITEM_STATES", "EpisodeStore", "store_frame"]

_STATISTICS_STEPS = 100_000
_FILES: Final = {schema.ITEM_ID: "items.parquet", schema.USER_ID: "users.parquet"}
_PLAIN: Final = (schema.TIMESTAMP, schema.REWARD, schema.PROPENSITY, schema.IS_RANDOM)
_LISTS: Final = (schema.OBSERVATION, schema.ACTION)


class EpisodeStore(EpisodeView):
    """Episodes (user sessions, robot trajectories) of a store, or a view of some of them.

    `open`, `write` and `from_arrays` (in memory) return a view of all episodes of a store; `split`
    and `select` return other views of the same columns. Views are never modified.
    """

    @classmethod
    def open(cls, path: str | Path) -> "EpisodeStore":
        """Open a store folder; only `meta.json` is read, columns are memory-mapped on first use.

        Raises:
            InputError: the folder is not a store, is damaged, or was written by a newer ucfrec.
        """
        return cls(Columns.open(Path(path)))

    @classmethod
    def write(
        cls,
        path: Path,
        steps: Mapping[str, Array],
        lengths: IntArray,
        episodes: Mapping[str, Array] | None = None,
        reward: str = schema.REWARD,
        source: Mapping[str, Any] | None = None,
        shard_steps: int = 2**24,
    ) -> "EpisodeStore":
        """Write a store from arrays in memory, atomically.

        Args:
            steps: step columns of `ucfrec.schema`, each (N,) or (N, size).
            lengths: (E,) number of steps of each episode, at least 1, with sum N.
            episodes: episode columns of `ucfrec.schema`, each (E,); without `split`, all episodes
                are in the training split.
            reward: the expression that computed the rewards, for the record.
            source: what the store was made from, for the record.
            shard_steps: a shard ends with the first episode that brings it to this many steps.

        Raises:
            InputError: `path` exists already, an episode has no steps, columns differ in length, or
                rewards are not finite.
        """
        values = _with_split(episodes, lengths)
        write_arrays(path, steps, lengths, values, reward, source or {}, shard_steps)
        return cls.open(path)

    @classmethod
    def from_arrays(
        cls,
        steps: Mapping[str, Array],
        lengths: IntArray,
        episodes: Mapping[str, Array] | None = None,
        item_states: ItemStates | None = None,
    ) -> "EpisodeStore":
        """Make a store in memory, without files.

        Args:
            steps: step columns of `ucfrec.schema`, each (N,) or (N, size).
            lengths: (E,) number of steps of each episode, at least 1, with sum N.
            episodes: episode columns of `ucfrec.schema`, each (E,); without `split`, all episodes
                are in the training split.
            item_states: builds states from items; required if actions are items.

        Raises:
            InputError: an episode has no steps, columns differ in length, or rewards are not
                finite.
        """
        lengths = require_steps("a store in memory", lengths)
        require_finite(steps[schema.REWARD])
        values = _with_split(episodes, lengths)
        return cls(Columns.from_arrays(steps, lengths, values, item_states))

    # For notebooks.

    def to_frame(self) -> "pd.DataFrame":
        """One row per step, with the identifiers of the logs; see `store_frame`."""
        return store_frame(self)

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Histogram of the episodes' returns on matplotlib axes."""
        from matplotlib import pyplot

        axes = pyplot.subplots()[1] if ax is None else ax
        axes.hist(self.returns, bins=30)
        axes.set_xlabel(f"return of an episode (sum of {self.record.reward})")
        axes.set_ylabel("episodes")
        return axes

    def _repr_html_(self) -> str:
        heads = ("", "episodes", "steps", "mean return")
        views = {name: self.split(name) for name in schema.SPLITS}
        lines = [
            (name, f"{len(view):,}", f"{view.n_steps:,}", f"{view.returns.mean():.4g}")
            for name, view in {"all": self, **views}.items()
            if len(view)
        ]
        head = "".join(f"<th>{text}</th>" for text in heads)
        body = "".join(f"<tr><td>{'</td><td>'.join(line)}</td></tr>" for line in lines)
        return f"<p>{escape(repr(self))}</p><table><tr>{head}</tr>{body}</table>"

    # Views.

    def select(self, episodes: IntArray) -> "EpisodeStore":
        """A view of the episodes at the given positions of this view, in the given order.

        Args:
            episodes: positions, 0 to E − 1, of any number.
        """
        return EpisodeStore(self._columns, self.episode_ids[episodes])

    def split(self, name: str) -> "EpisodeStore":
        """A view of the episodes in one split.

        Args:
            name: "train", "validation" or "test"; the split may be empty.

        Raises:
            InputError: `name` is none of these.
        """
        if name not in schema.SPLITS:
            raise InputError(f"no split is called {name!r}; there are {', '.join(schema.SPLITS)}")
        in_split = self.episode_values(schema.SPLIT) == schema.SPLITS.index(name)
        return self.select(np.flatnonzero(in_split))

    @cached_property
    def whole(self) -> "EpisodeStore":
        """A view of all episodes of the store."""
        return EpisodeStore(self._columns)

    def with_returns_to_go(
        self, values: Float32Array, definition: ReturnToGo | None = None
    ) -> "EpisodeStore":
        """A view of the same episodes with other returns-to-go; the files are not changed.

        Args:
            values: (n_steps,) returns-to-go in reward units, in the order of `all_steps`.
            definition: what they count; None for what they counted before.
        """
        name = schema.RETURN_TO_GO
        returns = self._columns.step_column(name).take(np.arange(self.record.n_steps))
        episodes, steps = self.all_steps()
        returns[self._columns.starts[self.episode_ids[episodes]] + steps] = values
        columns = self._columns.replace(name, StepColumn([returns]), (), definition)
        return EpisodeStore(columns, self._selected)

    def with_return_to_go(self, definition: ReturnToGo) -> "EpisodeStore":
        """A view of the same episodes whose returns-to-go are counted by `definition`."""
        rewards = self.step_values(schema.REWARD, *self.all_steps())
        offsets = np.concatenate([[0], np.cumsum(self.lengths)])
        return self.with_returns_to_go(definition.of_logs(rewards, offsets), definition)

    def without_observation_dimensions(self, dimensions: Sequence[int]) -> "EpisodeStore":
        """A view of the same episodes without some dimensions of the observations.

        Args:
            dimensions: to remove, each 0 to O − 1.
        """
        rest = np.setdiff1d(np.arange(self.observation_size), dimensions)
        column = self._columns.step_column(schema.OBSERVATION).select_dimensions(rest)
        columns = self._columns.replace(schema.OBSERVATION, column, (len(rest),), None)
        return EpisodeStore(columns, self._selected)

    @cached_property
    def state_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, each (S,) float32, of the states of the view.

        Computed in float64 from at most 100,000 steps, evenly spaced over the view.
        """
        stride = -(-self.n_steps // _STATISTICS_STEPS)
        total = torch.zeros(self.state_size, dtype=torch.float64)
        squares, count = total.clone(), 0
        for chunk in range(0, self.n_steps, stride * 8192):
            part = np.arange(chunk, min(chunk + stride * 8192, self.n_steps), stride)
            states = self.windows(*self.locate(part), 1).states[:, 0].double()
            total, squares = total + states.sum(0), squares + states.square().sum(0)
            count += len(states)
        mean = total / count
        variance = (squares / count - mean.square()).clamp(min=0)
        return mean.float(), variance.sqrt().float()


def _with_split(episodes: Mapping[str, Array] | None, lengths: IntArray) -> dict[str, Array]:
    return {schema.SPLIT: np.zeros(len(lengths), dtype=np.uint8), **(episodes or {})}


def store_frame(store: EpisodeStore) -> "pd.DataFrame":
    """One row per step, session by session: `user_id`, `session_id` (the number of the session in
    the store; one for all episodes of a session that a split boundary cuts), `item_id` or `action`,
    the other columns of the log that the store has, and `split`.

    Raises:
        InputError: a file of the store is damaged.
    """
    import pandas as pd  # most stores are never shown

    episodes, steps = store.all_steps()
    columns: dict[str, Any] = {}
    if store.has_users:
        users = store.episode_values(schema.USER)[episodes]
        columns[schema.USER_ID] = _named(store, schema.USER_ID, users)
    columns[schema.SESSION_ID] = _sessions(store)[episodes]
    if store.has_items:
        items = store.step_values(schema.ITEM, episodes, steps)
        columns[schema.ITEM_ID] = _named(store, schema.ITEM_ID, items)
    for name in _PLAIN:
        if name in store.record.columns:
            columns[name] = store.step_values(name, episodes, steps)
    for name in _LISTS:
        if name in store.record.columns:
            columns[name] = list(store.step_values(name, episodes, steps))
    splits = store.episode_values(schema.SPLIT)[episodes]
    columns[schema.SPLIT] = np.asarray(schema.SPLITS, dtype=object)[splits]
    return pd.DataFrame(columns)


def _sessions(store: EpisodeStore) -> IntArray:
    """(E,) number of each episode's session, which is that of its first episode."""
    numbers = store.episode_ids
    has_ends = store._columns.has_episode_column(schema.TERMINATED)
    if not (store.has_users and has_ends) or len(store) < 2:
        return numbers
    users, splits, ended = (
        store.episode_values(name) for name in (schema.USER, schema.SPLIT, schema.TERMINATED)
    )
    goes_on = (users[1:] == users[:-1]) & (splits[1:] > splits[:-1]) & (ended[:-1] == 0)
    goes_on &= np.diff(numbers) == 1
    first = np.concatenate([[True], ~goes_on])
    return np.asarray(numbers[first][np.cumsum(first) - 1])


def _named(store: EpisodeStore, column: str, numbers: IntArray) -> Array:
    """Identifiers of the logs; the numbers themselves in a store without their table."""
    path = store.path / _FILES[column]
    return read_ids(path, column)[numbers] if path.exists() else numbers
