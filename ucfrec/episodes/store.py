"""EpisodeStore: memory-mapped episodes, gathered as windows or single transitions; and the rows
of the users of a later store in both."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.episodes.item_table import ITEM_STATES
from ucfrec.episodes.record import LONG, Source, StoreRecord
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.view import Columns, EpisodeView, StepColumn
from ucfrec.episodes.windows import list_earlier
from ucfrec.episodes.writer import StoreWriter, require_finite, require_steps
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder
from ucfrec.files.parquet import read_ids

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ITEM_STATES", "EpisodeStore"]

LONGEST_HISTORY = 1000
"""Most recent rows of a user that are read; older ones only count as seen."""
_STATISTICS_STEPS = 100_000
_FILES = {schema.ITEM_ID: "items.parquet", schema.USER_ID: "users.parquet"}
_PLAIN = (schema.TIMESTAMP, schema.REWARD, schema.PROPENSITY, schema.IS_RANDOM)
_LISTS = (schema.OBSERVATION, schema.ACTION)


class EpisodeStore(EpisodeView):
    """Episodes (user sessions, robot trajectories) of a store, or a view of some of them.

    `open`, `write` and `from_arrays` (in memory) return a view of all episodes of a store; `split`
    and `select` return other views of the same columns. Views are never modified.
    """

    @classmethod
    def open(cls, path: str | Path) -> "EpisodeStore":
        """Open a store folder; only `meta.json` is read, columns are memory-mapped on first use.
        InputError if the folder is not a store, is damaged, or was written by a newer ucfrec."""
        path = Path(path)
        return cls(Columns(path, StoreRecord.read(path)))

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
            reward, source: the expression of the rewards, and what the store was made from.
            shard_steps: a shard ends with the first episode that brings it to this many steps.

        Raises:
            InputError: `path` exists already, an episode has no steps, columns differ in length, or
                rewards are not finite.
        """
        lengths = require_steps(path, lengths)
        first = np.zeros(int(np.sum(lengths)), dtype=bool)
        first[np.cumsum(lengths) - lengths] = True
        columns = {schema.SPLIT: np.zeros(len(lengths), dtype=np.uint8), **(episodes or {})}
        repeated = {name: np.repeat(values, lengths) for name, values in columns.items()}
        with atomic_folder(path) as scratch:
            writer = StoreWriter(scratch, shard_steps)
            writer.append(steps, first, repeated)
            writer.finish(reward=reward, source=source or {})
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

        Args and errors are those of `write`; `item_states` are required if actions are items.
        """
        lengths = require_steps("a store in memory", lengths)
        require_finite(steps[schema.REWARD])
        offsets = _offsets(lengths)
        splits = {schema.SPLIT: np.zeros(len(lengths), dtype=np.uint8)}
        dtypes, arrays = schema.STEP_DTYPES | schema.EPISODE_DTYPES, dict[str, Array]()
        for name, values in {**steps, **splits, **(episodes or {})}.items():
            arrays[name] = np.asarray(values, dtypes[name])
            what, expected = ("step", offsets[-1]) if name in steps else ("episode", len(lengths))
            if len(values) != expected:
                raise InputError(
                    f"column {name!r} has {len(values)} values instead of {expected}; give one per "
                    f"{what}"
                )
        record = StoreRecord(
            files={},
            version=schema.STORE_VERSION,
            n_steps=int(offsets[-1]),
            n_episodes=len(lengths),
            n_shards=0,
            columns={name: list(arrays[name].shape[1:]) for name in steps},
            fingerprint="",
            reward=schema.REWARD,
            source=Source(),
        )
        arrays[schema.OFFSETS] = offsets
        arrays[schema.RETURN_TO_GO] = ReturnToGo().of_logs(arrays[schema.REWARD], offsets)
        return cls(Columns(Path("<memory>"), record, arrays, item_states))

    def to_frame(self) -> "pd.DataFrame":
        """One row per step, session by session: `user_id`, `session_id` (the number of the session
        in the store; one for all episodes of a session that a split boundary cuts), `item_id` or
        `action`, the other columns of the log that the store has, and `split`. InputError if a file
        of the store is damaged."""
        import pandas as pd  # most stores are never shown

        episodes, steps = self.all_steps()
        columns: dict[str, Any] = {}
        if self.has_users:
            users = self.episode_values(schema.USER)[episodes]
            columns[schema.USER_ID] = self._read_ids(schema.USER_ID, users)
        columns[schema.SESSION_ID] = self._number_sessions()[episodes]
        if self.has_items:
            items = self.step_values(schema.ITEM, episodes, steps)
            columns[schema.ITEM_ID] = self._read_ids(schema.ITEM_ID, items)
        for name in (*_PLAIN, *_LISTS):
            if name in self.record.columns:
                values = self.step_values(name, episodes, steps)
                columns[name] = list(values) if name in _LISTS else values
        splits = self.episode_values(schema.SPLIT)[episodes]
        columns[schema.SPLIT] = np.asarray(schema.SPLITS, dtype=object)[splits]
        return pd.DataFrame(columns)

    def _number_sessions(self) -> IntArray:
        """(E,) number of each episode's session, which is that of its first episode."""
        numbers = self.episode_ids
        if not self.has_users or not len(self):
            return numbers
        users, splits = (self.episode_values(n).astype(int) for n in (schema.USER, schema.SPLIT))
        same_user = (np.diff(users) == 0) & (np.diff(numbers) == 1)
        goes_on = same_user & (np.diff(splits) > 0)
        first = np.append(True, ~goes_on | self.terminated[:-1])
        return np.asarray(numbers[first][np.cumsum(first) - 1])

    def _read_ids(self, column: str, numbers: IntArray) -> Array:
        """Identifiers of the logs; the numbers themselves in a store without their table."""
        path = self.path / _FILES[column]
        return read_ids(path, column)[numbers] if path.exists() else numbers

    def _repr_html_(self) -> str:
        table = "<tr><th></th><th>episodes</th><th>steps</th><th>mean return</th></tr>"
        for name, view in (("all", self), *((name, self.split(name)) for name in schema.SPLITS)):
            if len(view):
                cells = name, f"{len(view):,}", f"{view.n_steps:,}", f"{view.returns.mean():.4g}"
                table += f"<tr><td>{'</td><td>'.join(cells)}</td></tr>"
        return f"<p>{escape(repr(self))}</p><table>{table}</table>"

    def select(self, episodes: IntArray | BoolArray) -> "EpisodeStore":
        """A view of the episodes at these positions of this view, in their order, or of a mask."""
        return EpisodeStore(self._columns, self.episode_ids[episodes])

    def divide(self, chosen: BoolArray) -> "tuple[EpisodeStore, EpisodeStore]":
        """Views of the episodes where a mask (E,) is false, and of those where it is true."""
        return self.select(~chosen), self.select(chosen)

    def split(self, name: str) -> "EpisodeStore":
        """A view of the episodes in one split, which may be empty. InputError if `name` is not
        "train", "validation" or "test"."""
        if name not in schema.SPLITS:
            raise InputError(f"no split is called {name!r}; there are {', '.join(schema.SPLITS)}")
        return self.select(self.episode_values(schema.SPLIT) == schema.SPLITS.index(name))

    def without_long_sessions(self) -> "EpisodeStore":
        """The view without sessions of more than `LONG` times the median number of steps.

        One session of thousands of steps would otherwise set the largest target return, be a good
        part of the rows that the user model is fitted to, and let simulated sessions go on as long.
        """
        if not len(self):
            return self
        usual = self.lengths <= LONG * np.median(self.lengths)
        return self if usual.all() else self.select(usual)

    @cached_property
    def whole(self) -> "EpisodeStore":
        """A view of all episodes of the store."""
        return EpisodeStore(self._columns)

    def with_returns_to_go(self, values: Float32Array) -> "EpisodeStore":
        """A view of the same episodes with other returns-to-go (n_steps,), in reward units and the
        order of `all_steps`. The files are not changed."""
        name, n_steps = schema.RETURN_TO_GO, self.record.n_steps
        returns = self._columns.step_column(name).take(np.arange(n_steps))
        episodes, steps = self.all_steps()
        returns[self._columns.starts[self.episode_ids[episodes]] + steps] = values
        return EpisodeStore(self._columns.replace(name, StepColumn([returns])), self._selected)

    def with_return_to_go(self, definition: ReturnToGo) -> "EpisodeStore":
        """A view of the same episodes whose returns-to-go are counted by `definition`."""
        columns = self._columns
        rewards = columns.step_column(schema.REWARD).take(np.arange(self.record.n_steps))
        returns = StepColumn([definition.of_logs(rewards, _offsets(columns.lengths))])
        columns = columns.replace(schema.RETURN_TO_GO, returns, return_to_go=definition)
        return EpisodeStore(columns, self._selected)

    def without_observation_dimensions(self, dimensions: Sequence[int]) -> "EpisodeStore":
        """A view of the same episodes without some dimensions of the observations, 0 to O − 1."""
        remaining = np.setdiff1d(np.arange(self.observation_size), dimensions)
        name, size = schema.OBSERVATION, len(remaining)
        record = self.record.copy_with(columns={**self.record.columns, name: [size]})
        column = self._columns.step_column(name).select_dimensions(remaining)
        columns = self._columns.replace(name, column, record=record, observation_size=size)
        return EpisodeStore(columns, self._selected)

    @cached_property
    def state_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, each (S,) float32, of the view's states; rounding errors are
        0. Of many, a step drawn from each of 100,000 parts counts: episodes may be equally long."""
        count = min(self.n_steps, _STATISTICS_STEPS)
        places = self.n_steps / count * (np.arange(count) + np.random.default_rng(0).random(count))
        total = squares = torch.zeros(self.state_size, dtype=torch.float64)
        for part in np.array_split(places.astype(np.int64), -(-count // 8192)):
            states = self.windows(*self.locate(part), 1).states[:, 0].double()
            total, squares = total + states.sum(0), squares + states.square().sum(0)
        mean = total / count
        std = (squares / count - mean.square()).clamp(min=0).sqrt()
        return mean.float(), std.where(std > 1e-6 * mean.abs().clamp(min=1e-6), 0.0).float()


@dataclass(frozen=True)
class UserRows:
    """R rows of the users of a later log, earlier rows too, by user and time."""

    later: EpisodeStore
    """The later log, with N steps."""
    earlier: EpisodeStore | None
    source: IntArray
    """(R,) index of each row in the steps of `later`, or −1 less its index in `earlier`."""
    first: IntArray
    """(N,) first row of the user of each later step."""
    place: IntArray
    """(N,) row of each later step."""

    @classmethod
    def of(
        cls,
        later: EpisodeStore,
        users: Array,
        earlier: EpisodeStore | None,
    ) -> "UserRows":
        """Collect the rows.

        Args:
            users: (E,) identifier of the user of each later episode.
            earlier: a store with the same numbers of users and items, of which only rows before the
                user's first later row count.
        """
        owners = np.unique(users, return_inverse=True)[1]
        episodes, steps = later.all_steps()
        owner, source = owners[episodes], np.arange(len(steps))
        times = _times(later, episodes, steps)
        if earlier is not None and later.has_users and earlier.has_users:
            begins = np.full(len(users), np.iinfo(np.int64).max)
            np.minimum.at(begins, owner, times)
            users_later = later.episode_values(schema.USER)
            users_earlier = earlier.episode_values(schema.USER)
            # Owner of each user, and −1 for the user −1, the last.
            owner_of = np.full(
                max(users_later.max(initial=0), users_earlier.max(initial=0)) + 2, -1
            )
            owner_of[users_later], owner_of[-1] = owners, -1
            owners_earlier = owner_of[users_earlier]
            parts, taken = [(owner, times, source)], 0
            for episodes, steps in earlier.step_batches():
                owner = owners_earlier[episodes]
                rows = np.flatnonzero(owner >= 0)
                times = _times(earlier, episodes[rows], steps[rows])
                is_earlier = times < begins[owner[rows]]
                rows = rows[is_earlier]
                parts.append((owner[rows], times[is_earlier], -1 - (taken + rows)))
                taken += len(steps)
            owner, times, source = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        order = np.lexsort((times, owner))
        source = source[order]
        rows = np.flatnonzero(source >= 0)
        place = np.empty(len(rows), dtype=np.int64)
        place[source[rows]] = rows
        first = np.searchsorted(owner[order], owner[order][place])
        return cls(later, earlier, source, first, place)

    def values(self, name: str, source: IntArray) -> Array:
        """Values of a step column at sources of any shape; see `source`. Of candidates, whose sets
        have other numbers in an earlier store, its rows have none."""
        later, earlier = self.later, self.earlier
        values = later.step_values(name, *later.locate(np.maximum(source, 0)))
        if earlier is not None and (source < 0).any():
            values[source < 0] = -1 if name in (schema.SESSION_BEGAN, schema.CANDIDATES) else 0
            if name in earlier.record.columns and name != schema.CANDIDATES:
                steps = earlier.locate(-1 - source[source < 0])
                values[source < 0] = earlier.step_values(name, *steps)
        return values

    def recent(self, steps: IntArray, count: int) -> tuple[IntArray, Float32Array]:
        """The items and rewards (B, count) of the user's latest rows before later steps (B,),
        most recent first; −1 and 0 where there are fewer."""
        rows = self.place[self._starts(steps)][:, None] - np.arange(1, count + 1)
        missing = rows < self.first[steps][:, None]
        source = self.source[np.maximum(rows, 0)]
        items = np.where(missing, -1, self.values(schema.ITEM, source)).astype(np.int64)
        rewards = np.where(missing, 0, self.values(schema.REWARD, source)).astype(np.float32)
        return items, rewards

    def seen(self, steps: IntArray) -> tuple[IntArray, IntArray]:
        """(rows, items), each (M,): the known items in all rows of the user before later steps
        (B,); `rows` are indices into the B."""
        first = self.first[steps]
        owner, inside = list_earlier(self.place[self._starts(steps)] - first)
        source = self.source[first[owner] + inside]
        items = self.values(schema.ITEM, source).astype(np.int64)
        return owner[items >= 0], items[items >= 0]

    def _starts(self, steps: IntArray) -> IntArray:
        """The first rows (B,) of the decisions that later steps (B,) belong to."""
        episodes, numbers = self.later.locate(steps)
        return steps - (numbers - self.later.decision_starts(episodes, numbers))

    def continue_sessions(self, gap_ms: float | None) -> EpisodeStore:
        """The later log, with the rows before it in the sessions that go on in it; a pause of more
        than `gap_ms` ends one, None none. Earlier rows are known but `all_steps` excludes them."""
        if self.earlier is None and schema.SESSION_BEGAN not in self.later.record.columns:
            return self.later
        begin = self.place[np.cumsum(self.later.lengths) - self.later.lengths]
        counts = np.minimum(begin - self._begins(begin, gap_ms), LONGEST_HISTORY)
        if not counts.any():
            return self.later
        return EpisodeStore(self._continue_columns(begin, counts))

    def _continue_columns(self, begin: IntArray, counts: IntArray) -> Columns:
        """The columns of the later episodes, with the `counts` (E,) rows before `begin` (E,)."""
        later, lengths = self.later, self.later.lengths + counts
        offsets = _offsets(lengths)
        inside = np.arange(offsets[-1]) - np.repeat(offsets[:-1] + counts, lengths)
        numbers = np.repeat(np.cumsum(later.lengths) - later.lengths, lengths) + inside
        earlier_source = self.source[np.repeat(begin, lengths) + inside.clip(max=0)]
        source = np.where(inside >= 0, numbers, earlier_source)
        names = [name for name in schema.EPISODE_DTYPES if later._columns.has_episode_column(name)]
        arrays = {name: later.episode_values(name) for name in names}
        arrays[schema.OFFSETS] = offsets
        rewards = self.values(schema.REWARD, source)
        arrays[schema.RETURN_TO_GO] = ReturnToGo().of_logs(rewards, offsets)
        record = later.record.copy_with(
            files={}, n_steps=len(source), n_episodes=len(lengths), n_shards=0
        )
        columns = Columns(later.path, record, arrays, later.item_states)
        columns.skipped = counts
        for name in record.columns:
            columns = columns.replace(name, StepColumn([_JoinedRows(self, name, source)]))
        return columns

    def _begins(self, begin: IntArray, gap_ms: float | None) -> IntArray:
        """(E,) row at which the session of each later episode begins, whose first row is `begin`:
        an earlier row, or the same."""
        times = self.values(schema.TIMESTAMP, self.source)
        pause = np.diff(times) > (np.inf if gap_ms is None else gap_ms)
        breaks = np.append(True, pause | (self.source[:-1] >= 0))
        breaks[self.first] = True
        starts = np.flatnonzero(breaks)
        begins = starts[np.searchsorted(starts, begin, side="right") - 1]
        if gap_ms is None or schema.SESSION_BEGAN not in self.later.record.columns:
            return begins
        # Rows from the time on that the log names, of users by their first rows.
        episodes, steps = self.later.locate(self.source[begin])
        began = self.later.step_values(schema.SESSION_BEGAN, episodes, steps)
        users, low = np.unique(self.first), times.min()
        owner = np.searchsorted(users, np.arange(len(times)), side="right")
        span = times.max() - low + 1
        since = np.where(began == times[begin], began, began - schema.CLOCKS_DIFFER_MS)
        keys, wanted_keys = owner * span + times - low, (since - low).clip(0, span - 1)
        starts_named = np.searchsorted(keys, owner[begin] * span + wanted_keys)
        return np.where(began < 0, begins, np.minimum(starts_named, begin))


def _times(store: EpisodeStore, episodes: IntArray, steps: IntArray) -> IntArray:
    if schema.TIMESTAMP not in store.record.columns:
        return np.arange(len(steps))
    return store.step_values(schema.TIMESTAMP, episodes, steps)


class _JoinedRows:
    """Values of rows that lie in two stores, as an array is indexed."""

    def __init__(
        self,
        rows: UserRows,
        name: str,
        source: IntArray,
    ) -> None:
        self._rows, self._name, self._source = rows, name, source

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: IntArray | slice) -> Array:
        return self._rows.values(self._name, self._source[index])


def _offsets(lengths: IntArray) -> IntArray:
    return np.append(0, np.cumsum(lengths)).astype(np.int64)
