"""Order statistics of rows on disk, in bounded memory: exact quantiles, and rows out of order."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from ucfrec.arrays import Array
from ucfrec.logs.spool import BLOCK, Spool

_BINS: Final = 2**16
_NEVER: Final = np.iinfo(np.int64).max


def ranked(
    spool: Spool, name: str, low: int, high: int, positions: Sequence[int], block: int = BLOCK
) -> list[int]:
    """The values that a column of integers would have at the given positions if it were sorted.

    Args:
        spool: with the column `name`.
        name: of the column.
        low: no value is below it.
        high: no value is above it.
        positions: each from 0 to the number of rows, exclusive.
        block: rows in memory at a time.
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
        block: rows in memory at a time.
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
