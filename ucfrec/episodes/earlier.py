"""What the users of a later log were shown before it, and before each of its steps."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.episodes.returns import returns_to_go
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.view import Columns, StepColumn

LONGEST_HISTORY: Final = 1000
"""Most recent rows of a user that are read; older ones only count as seen."""


@dataclass(frozen=True)
class UserRows:
    """R rows of the users of a later log, earlier rows too, by user and time."""

    later: EpisodeStore
    """The later log, with N steps."""
    earlier: EpisodeStore | None
    source: IntArray
    """(R,) index of each row among the steps of `later`, or −1 less its index among those of
    `earlier`."""
    first: IntArray
    """(N,) first row of the user of each later step."""
    place: IntArray
    """(N,) row of each later step."""

    @classmethod
    def of(cls, later: EpisodeStore, users: Array, earlier: EpisodeStore | None) -> "UserRows":
        """Collect the rows.

        Args:
            users: (E,) identifier of the user of each of its episodes.
            earlier: a store with the same numbers of users and items; rows that are not before the
                user's first later row are left out. None for none.
        """
        owners = np.unique(users, return_inverse=True)[1]
        episodes, steps = later.all_steps()
        owner, source = owners[episodes], np.arange(len(steps))
        times = _times(later, episodes, steps)
        if earlier is not None and later.has_users and earlier.has_users:
            begins = np.full(len(users), np.iinfo(np.int64).max)
            np.minimum.at(begins, owner, times)
            users_earlier = later.episode_values(schema.USER).astype(np.int64)
            more = _earlier_rows(earlier, users_earlier, owners, begins)
            owner, times, source = (
                np.concatenate(pair) for pair in zip(more, (owner, times, source), strict=True)
            )
        order = np.lexsort((times, owner))
        place = np.empty(len(steps), dtype=np.int64)
        rows = np.flatnonzero(source[order] >= 0)
        place[source[order][rows]] = rows
        first = np.searchsorted(owner[order], owner[order][place])
        return cls(later, earlier, source[order], first, place)

    def values(self, name: str, rows: IntArray) -> Array:
        """Values of a step column at rows of any shape."""
        return _join(name, self.later, self.earlier, self.source[rows])

    def recent(self, steps: IntArray, count: int) -> tuple[IntArray, Float32Array]:
        """The items and rewards (B, count) of the user's latest rows before later steps (B,),
        most recent first; −1 and 0 where there are fewer."""
        rows = self.place[steps][:, None] - np.arange(1, count + 1)
        missing = rows < self.first[steps][:, None]
        rows = np.maximum(rows, 0)
        items = np.where(missing, -1, self.values(schema.ITEM, rows)).astype(np.int64)
        rewards = np.where(missing, 0, self.values(schema.REWARD, rows)).astype(np.float32)
        return items, rewards

    def seen(self, steps: IntArray) -> tuple[IntArray, IntArray]:
        """(rows, items), each (M,): the known items in all rows of the user before later steps
        (B,); `rows` are indices into the B."""
        first, counts = self.first[steps], self.place[steps] - self.first[steps]
        owner = np.repeat(np.arange(len(steps)), counts)
        inside = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        items = self.values(schema.ITEM, first[owner] + inside).astype(np.int64)
        return owner[items >= 0], items[items >= 0]

    def continued(self, gap_ms: float | None) -> EpisodeStore:
        """The later log, with the rows before it in the sessions that go on in it.

        These rows are known but are not steps of the view: `all_steps` leaves them out.

        Args:
            gap_ms: pause (ms) that ends a session; None if a session is all of a user.
        """
        if self.earlier is None:
            return self.later
        begin = self.place[np.cumsum(self.later.lengths) - self.later.lengths]
        counts = np.minimum(begin - self._begins(begin, gap_ms), LONGEST_HISTORY)
        if not counts.any():
            return self.later
        return EpisodeStore(_ContinuedColumns(self, begin, counts))

    def _begins(self, begin: IntArray, gap_ms: float | None) -> IntArray:
        """(E,) row at which the session of each later episode begins, whose first row is `begin`:
        an earlier row, or the same."""
        breaks = np.ones(len(self.source), dtype=bool)
        inside = np.arange(1, len(self.source))
        times = self.values(schema.TIMESTAMP, np.arange(len(self.source))).astype(np.int64)
        pause = np.diff(times) > (np.inf if gap_ms is None else gap_ms)
        breaks[1:] = pause | (self.source[inside - 1] >= 0)
        breaks[np.unique(self.first)] = True
        starts = np.flatnonzero(breaks)
        return np.asarray(starts[np.searchsorted(starts, begin, side="right") - 1])


def _times(store: EpisodeStore, episodes: IntArray, steps: IntArray) -> IntArray:
    if schema.TIMESTAMP not in store.record.columns:
        return np.arange(len(steps))
    return store.step_values(schema.TIMESTAMP, episodes, steps).astype(np.int64)


def _earlier_rows(
    earlier: EpisodeStore, users_earlier: IntArray, owners: IntArray, begins: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Owner, time (ms) and source of the earlier rows of users, in the order of the store.

    Args:
        users_earlier: (E,) its number of the user of each later episode; −1 for others.
        owners: (E,) that user's number among the later ones.
        begins: (U,) time at which the user's later rows begin.
    """
    numbers = np.full(max(int(users_earlier.max(initial=-1)), 0) + 2, -1)
    numbers[users_earlier[users_earlier >= 0]] = owners[users_earlier >= 0]
    users = earlier.episode_values(schema.USER).astype(np.int64)
    owner_of = numbers[np.where((users >= 0) & (users < len(numbers) - 1), users, -1)]
    parts = []
    taken = 0
    for episodes, steps in earlier.step_batches():
        owner = owner_of[episodes]
        candidates = np.flatnonzero(owner >= 0)
        times = _times(earlier, episodes[candidates], steps[candidates])
        is_earlier = times < begins[owner[candidates]]
        rows = candidates[is_earlier]
        parts.append((owner[rows], times[is_earlier], -1 - (taken + rows)))
        taken += len(steps)
    owner, times, source = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return owner, times, source


def _join(name: str, later: EpisodeStore, earlier: EpisodeStore | None, source: IntArray) -> Array:
    """Values of a step column at sources of any shape; see `UserRows.source`."""
    values = later.step_values(name, *later.locate(np.maximum(source, 0)))
    is_earlier: BoolArray = source < 0
    if earlier is not None and is_earlier.any():
        values[is_earlier] = earlier.step_values(name, *earlier.locate(-1 - source[is_earlier]))
    return values


class _JoinedColumn(StepColumn):
    """A step column of rows that lie in two stores."""

    def __init__(self, rows: UserRows, name: str, source: IntArray) -> None:
        super().__init__([])
        self._rows, self._name, self._source = rows, name, source

    def __len__(self) -> int:
        return len(self._source)

    def take(self, index: IntArray) -> Array:
        """A copy of the values at the indices `index`, of any shape."""
        return _join(self._name, self._rows.later, self._rows.earlier, self._source[index])

    def between(self, begin: int, end: int) -> Array:
        """The values from index `begin` to before `end`."""
        return self.take(np.arange(begin, end))


class _ContinuedColumns(Columns):
    """The columns of later episodes, each with the earlier rows of its session before it."""

    def __init__(self, rows: UserRows, begin: IntArray, counts: IntArray) -> None:
        """
        Args:
            begin: (E,) row of the first step of each later episode.
            counts: (E,) rows before it that belong to the session.
        """
        later = rows.later
        lengths = later.lengths + counts
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        inside = np.arange(offsets[-1]) - np.repeat(offsets[:-1] + counts, lengths)
        numbers = np.repeat(np.cumsum(later.lengths) - later.lengths, lengths) + inside
        source = np.where(
            inside >= 0, numbers, rows.source[np.repeat(begin, lengths) + inside.clip(max=0)]
        )
        rewards = _join(schema.REWARD, later, rows.earlier, source)
        arrays = {
            name: later.episode_values(name)
            for name in schema.EPISODE_DTYPES
            if later.has_episode_values(name)
        }
        arrays |= {schema.OFFSETS: offsets, schema.RETURN_TO_GO: returns_to_go(rewards, offsets)}
        sizes = {"n_steps": len(source), "n_episodes": len(lengths), "n_shards": 0}
        record = later.record.copy_with(**sizes)
        super().__init__(later.path, record, arrays, later.item_states)
        self.skipped = counts
        self._steps = {name: _JoinedColumn(rows, name, source) for name in record.columns}
