"""Episodes of sorted rows: where sessions begin, how a split cuts them, which are kept.

Quantiles and rows out of order are found in bounded memory too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.logs.sorted_rows import SortedRows
from ucfrec.logs.spool import BLOCK, Spool


@dataclass(frozen=True)
class Cut:
    """How rows form episodes."""

    session_by: str
    """One of `ucfrec.logs.mapping.SESSIONS`."""
    gap_ms: int
    """With "gap": a longer pause (ms) ends the session."""
    min_steps: int
    """Episodes with fewer steps are dropped."""
    bounds: tuple[int, int]
    """Times (ms) at which the validation and the test split begin."""
    max_steps: int | None = None
    """Episodes with more steps are dropped; None for none."""


@dataclass(frozen=True)
class Episodes:
    """Consecutive episodes, with M rows in E episodes that are kept."""

    begin: int
    """First of their rows in the spool, dropped ones included."""
    end: int
    """Row after their last one."""
    kept: BoolArray | slice
    """Which of these rows are in episodes that are kept."""
    lengths: IntArray
    """(E,) steps."""
    users: IntArray
    """(E,) `user` of the spool."""
    splits: npt.NDArray[np.uint8]
    """(E,) 0 train, 1 validation, 2 test."""
    begins_session: BoolArray
    """(E,) false for the later pieces of a session that a split cuts."""
    terminated: BoolArray
    """(E,) false for episodes cut at a split and for sessions that may have gone on after the log
    ended: a user's last one if sessions are users, or if it ended within the gap before the end of
    the log."""
    long_rows: int
    """Rows of episodes that are dropped as too long."""

    def column(self, spool: Spool, name: str) -> Array:
        """(M,) or (M, size) rows of a column of the spool."""
        return np.asarray(spool.read(name, self.begin, self.end)[self.kept])


def split_bounds(rows: SortedRows, split: tuple[float, ...]) -> tuple[int, int]:
    """Times (ms) at which the validation and the test split begin.

    Args:
        rows: at least one usable row.
        split: three shares of the rows in order of time, or the two times (ms).
    """
    if len(split) == 2:
        return int(split[0]), int(split[1])
    n = len(rows.clean)
    positions = [round(n * split[0]), round(n * (split[0] + split[1]))]
    inside = [min(position, n - 1) for position in positions]
    found = ranked(rows.clean, schema.TIMESTAMP, rows.first_ms, rows.last_ms, inside)
    begin, end = (
        time if position < n else rows.last_ms + 1
        for time, position in zip(found, positions, strict=True)
    )
    return begin, end


def by_sessions(rows: SortedRows, folder: Path, block: int | None = None) -> Spool:
    """Usable rows in order of user, first row of the session, session, time and choice.

    Sessions of one user may overlap: each stays whole. All rows of one user are in memory at a
    time.

    Args:
        rows: with the column `session`.
        block: rows in memory at a time, or more if one user has more; None for as many as their
            length allows.
    """
    spool, clean = Spool(folder), rows.clean
    block = block or clean.block_rows
    begin = 0
    while begin < len(clean):
        end = end_of_user(clean, begin, block)
        columns = {name: clean.read(name, begin, end) for name in clean.names}
        users, sessions = columns["user"], columns["session"]
        # Rows are in order of time, so that the first row of a group is its earliest.
        grouped = np.lexsort((sessions, users))
        starts = np.concatenate([[True], np.diff(sessions[grouped]) != 0])
        starts[1:] |= np.diff(users[grouped]) != 0
        began = np.empty(len(users), dtype=np.int64)
        began[grouped] = columns[schema.TIMESTAMP][grouped][starts][np.cumsum(starts) - 1]
        order = np.lexsort((sessions, began, users))
        spool.append({name: values[order] for name, values in columns.items()})
        begin = end
    return spool


def end_of_user(spool: Spool, begin: int, rows: int) -> int:
    """End of the last user who ends within some rows of a sorted spool, or of the first one.

    Args:
        spool: with the column `user`.
    """
    while begin + rows < len(spool):
        users = spool.read("user", begin, begin + rows + 1)
        changes = np.flatnonzero(users[1:] != users[:-1])
        if len(changes):
            return begin + int(changes[-1]) + 1
        rows *= 2
    return len(spool)


def episodes(spool: Spool, cut: Cut, log_end: int, block: int | None = None) -> Iterator[Episodes]:
    """The episodes of sorted rows, those with too few or too many steps excluded.

    Args:
        spool: rows in the order of the store.
        log_end: time (ms) of the log's last usable row.
        block: rows in memory at a time, or more if one episode has more; None for as many as their
            length allows.
    """
    begin, block = 0, block or spool.block_rows
    while begin < len(spool):
        size = block
        while True:
            marks = _marks(spool, cut, begin, min(begin + size, len(spool)))
            firsts = np.flatnonzero(marks.first)
            if len(firsts) > 1:
                break
            size *= 2
        yield _episodes(marks, firsts, cut, begin, log_end)
        begin += int(firsts[-1])


@dataclass(frozen=True)
class _Marks:
    """Of rows and the one after them, which is past the end after the last row."""

    times: Array
    users: Array
    splits: Array
    starts: BoolArray
    """First rows of sessions."""
    new_user: BoolArray
    first: BoolArray
    """First rows of episodes."""


def _marks(spool: Spool, cut: Cut, begin: int, end: int) -> _Marks:
    """Marks of the rows `begin` to `end`, where an episode begins at `begin`."""
    low, high = max(begin - 1, 0), min(end + 1, len(spool))
    users = spool.read("user", low, high)
    times = spool.read(schema.TIMESTAMP, low, high)
    new_user = users[1:] != users[:-1]
    starts = new_user
    if cut.session_by == "gap":
        starts = new_user | (times[1:] - times[:-1] > cut.gap_ms)
    elif cut.session_by == schema.SESSION_ID:
        sessions = spool.read("session", low, high)
        starts = new_user | (sessions[1:] != sessions[:-1])
    splits = (times >= cut.bounds[0]).astype(np.uint8) + (times >= cut.bounds[1])
    first = starts | (splits[1:] != splits[:-1])
    head = [np.ones(1, dtype=bool)] if begin == 0 else []
    tail = [np.ones(1, dtype=bool)] if end == len(spool) else []
    own = slice(begin - low, None)
    return _Marks(
        times[own],
        users[own],
        splits[own],
        np.concatenate([*head, starts, *tail]),
        np.concatenate([*head, new_user, *tail]),
        np.concatenate([*head, first, *tail]),
    )


def _episodes(marks: _Marks, firsts: IntArray, cut: Cut, begin: int, log_end: int) -> Episodes:
    at, following = firsts[:-1], firsts[1:]
    lengths = np.diff(firsts)
    if cut.session_by == "gap":
        last_ends = log_end - marks.times[following - 1] > cut.gap_ms
    else:
        last_ends = np.full(len(at), cut.session_by == schema.SESSION_ID)
    terminated = np.where(marks.new_user[following], last_ends, marks.starts[following])
    too_long = lengths > (lengths.max() if cut.max_steps is None else cut.max_steps)
    fit = (lengths >= cut.min_steps) & ~too_long
    kept: BoolArray | slice = slice(None)
    if not fit.all():
        kept = np.repeat(fit, lengths)
    return Episodes(
        begin,
        begin + int(firsts[-1]),
        kept,
        lengths[fit],
        marks.users[at][fit],
        marks.splits[at][fit].astype(np.uint8),
        marks.starts[at][fit],
        terminated[fit],
        int(lengths[too_long].sum()),
    )


_BINS: Final = 2**16
_NEVER: Final = np.iinfo(np.int64).max


def ranked(
    spool: Spool, name: str, low: int, high: int, positions: Sequence[int], block: int = BLOCK
) -> list[int]:
    """The values that a column of integers would have at the given positions if it were sorted.

    Args:
        spool: with the column `name`.
        low: no value is below it.
        high: no value is above it.
        positions: each from 0 to the number of rows, exclusive.
    """
    # Each round counts values in bins and goes on within the bin that has the position.
    found = [(low, high, position) for position in positions]
    while any(start < end for start, end, _ in found):
        widths = [(end - start) // _BINS + 1 for start, end, _ in found]
        counts = np.zeros((len(found), _BINS), dtype=np.int64)
        for begin in range(0, len(spool), block):
            values = spool.read(name, begin, min(begin + block, len(spool)))
            for n, (start, end, _) in enumerate(found):
                bins = (values[(values >= start) & (values <= end)] - start) // widths[n]
                counts[n] += np.bincount(bins, minlength=_BINS)
        for n, (start, end, position) in enumerate(found):
            below = np.cumsum(counts[n])
            place = int(np.searchsorted(below, position, side="right"))
            position -= int(below[place - 1]) if place else 0
            start += place * widths[n]
            found[n] = start, min(start + widths[n] - 1, end), position
    return [start for start, _, _ in found]


def count_unsorted(placed: Spool, block: int = BLOCK) -> int:
    """Number of rows that follow a later row of the same user in the files.

    Args:
        placed: see `ucfrec.logs.sorted_rows.SortedRows.placed`.
    """
    # Such a row has a greater position than some row of the user with a later time. Going backwards
    # through the sorted rows, the least position so far is that of all later rows of the user.
    unsorted = 0
    user, time, least, later = -1, -1, _NEVER, _NEVER
    for users, times, rows in _backwards(placed, block):
        starts = np.flatnonzero(np.concatenate([[True], users[1:] != users[:-1]]))
        least_so_far = _suffix_minimum(rows, starts)
        same_user = np.zeros(len(rows), dtype=bool)
        if users[-1] == user:
            same_user[starts[-1] :] = True
            least_so_far[starts[-1] :] = np.minimum(least_so_far[starts[-1] :], least)
        # Rows of one time are not later than each other: skip to the first row of another time.
        ties = np.concatenate([[True], (users[1:] != users[:-1]) | (times[1:] != times[:-1])])
        begins = np.flatnonzero(ties)
        following = np.append(begins[1:], len(rows))[np.cumsum(ties) - 1]
        within = np.minimum(following, len(rows) - 1)
        next_user = np.where(following < len(rows), users[within], user)
        least_later = np.where(
            next_user == users,
            np.where(following < len(rows), least_so_far[within], least),
            _NEVER,
        )
        if users[-1] == user and times[-1] == time:
            least_later[begins[-1] :] = later
        unsorted += int(np.count_nonzero(rows > least_later))
        user, time = int(users[0]), int(times[0])
        least, later = int(least_so_far[0]), int(least_later[0])
    return unsorted


def _backwards(placed: Spool, block: int) -> Iterator[tuple[Array, Array, Array]]:
    for end in range(len(placed), 0, -block):
        begin = max(end - block, 0)
        users, times, rows = (placed.read(name, begin, end) for name in placed.names)
        yield users, times, rows


def _suffix_minimum(values: Array, starts: Array) -> Array:
    """Least of the values from each one to the end of its segment; segments begin at `starts`."""
    # Segments are moved apart, so that values of a later one are never the least of an earlier one.
    low = int(values.min())
    span = int(values.max()) - low + 1
    number = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(values))))
    moved = values - low + number * span
    least = np.minimum.accumulate(moved[::-1])[::-1]
    return np.asarray(least - number * span + low)
