"""Episodes of sorted rows: where sessions begin, how a split cuts them, which count."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.logs.sorted_rows import SESSION, USER, SortedRows

_BINS: Final = 2**16


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
    """The E episodes of some users that are neither too short nor too long, with M rows."""

    rows: dict[str, Array]
    """(M,) or (M, size) columns of `SortedRows.file`."""
    lengths: IntArray
    """(E,) steps."""
    users: IntArray
    """(E,) `USER`."""
    splits: IntArray
    """(E,) 0 train, 1 validation, 2 test."""
    begins_session: BoolArray
    """(E,) false for the later pieces of a session that a split cuts."""
    terminated: BoolArray
    """(E,) false for episodes cut at a split and for sessions that may have gone on after the log
    ended: a user's last one if sessions are users, or if it ended within the gap before the end of
    the log."""
    long_rows: int
    """Rows of episodes that are dropped as too long."""


def split_bounds(rows: SortedRows, split: tuple[float, ...]) -> tuple[int, int]:
    """Times (ms) at which the validation and the test split begin.

    Args:
        rows: at least one usable row.
        split: three shares of the rows in order of time, or the two times (ms).
    """
    if len(split) == 2:
        return int(split[0]), int(split[1])
    places = (round(rows.count * split[0]), round(rows.count * (split[0] + split[1])))
    begin, end = (_find_time(rows, place) for place in places)
    return begin, end


def _find_time(rows: SortedRows, place: int) -> int:
    """The time at a place of the sorted times; past the end, the time after the last."""
    low, high = rows.first_ms, rows.last_ms + 1
    # Each round counts times in bins, and goes on within the bin that has the place.
    while high - low > 1 and place < rows.count:
        width, counts = (high - low - 1) // _BINS + 1, np.zeros(_BINS, dtype=np.int64)
        for batch in rows.file.read(schema.TIMESTAMP):
            times = batch[schema.TIMESTAMP]
            inside = times[(times >= low) & (times < high)]
            counts += np.bincount((inside - low) // width, minlength=_BINS)
        below = np.cumsum(counts)
        chosen = int(np.searchsorted(below, place, side="right"))
        place -= int(below[chosen - 1]) if chosen else 0
        low, high = low + chosen * width, min(low + (chosen + 1) * width, high)
    return low if place < rows.count else rows.last_ms + 1


def read_episodes(rows: SortedRows, cut: Cut) -> Iterator[Episodes]:
    """Cut the rows into episodes, some thousand rows at a time."""
    for batch in rows.file.read():
        yield _cut_episodes(batch, cut, rows.last_ms)


def _cut_episodes(rows: dict[str, Array], cut: Cut, log_end: int) -> Episodes:
    """The episodes of all rows of some users."""
    users, times = rows[USER], rows[schema.TIMESTAMP]
    user_ends = users[1:] != users[:-1]
    ends = user_ends
    if cut.session_by == "gap":
        ends = user_ends | (times[1:] - times[:-1] > cut.gap_ms)
    elif cut.session_by == schema.SESSION_ID:
        ends = user_ends | (rows[SESSION][1:] != rows[SESSION][:-1])
    user_ends, ends = np.append(user_ends, True), np.append(ends, True)
    splits = (times >= cut.bounds[0]).astype(np.int64) + (times >= cut.bounds[1])
    last = np.flatnonzero(ends | np.append(splits[1:] != splits[:-1], True))
    lengths = np.diff(last, prepend=-1)
    begins_session = np.append(True, ends[last[:-1]])
    last_ends = np.full(len(last), cut.session_by == schema.SESSION_ID)
    if cut.session_by == "gap":
        last_ends = log_end - times[last] > cut.gap_ms
    terminated = np.where(user_ends[last], last_ends, ends[last])
    too_long = lengths > (lengths.max() if cut.max_steps is None else cut.max_steps)
    fits = (lengths >= cut.min_steps) & ~too_long
    if not fits.all():
        steps = np.repeat(fits, lengths)
        rows = {name: values[steps] for name, values in rows.items()}
    return Episodes(
        rows,
        lengths[fits],
        users[last][fits],
        splits[last][fits],
        begins_session[fits],
        terminated[fits],
        int(lengths[too_long].sum()),
    )
