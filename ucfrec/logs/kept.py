"""Which of a log's usable rows stay: the one rule for files, frames and requests."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.logs.binding import MAX_FLOAT

DUPLICATES: Final = {
    "highest": "has the highest",
    "lowest": "has the lowest",
    "first": "comes first in the files",
    "last": "comes last in the files",
}
"""Which of several rows with the same user, item or action, and time is kept: rule to its
description."""
_TIE_BREAKERS: Final = (
    schema.OBSERVATION,
    schema.PROPENSITY,
    "no_session",
    "session",
    schema.IS_RANDOM,
)
"""Columns that decide between duplicates that are equal to the rule, the most important first, so
that the order of rows and files does not matter."""


@dataclass(frozen=True)
class Kept:
    """The rows that are kept, and how many are not."""

    rows: IntArray
    """(K,) their positions, in order."""
    duplicates: int
    """Rows that repeat the user, time and choice of a row that counts in their place."""
    conflicts: int
    """Duplicates with another reward than that row."""
    undefined: int
    """Rows, not duplicates, whose reward is NaN or infinite."""


def kept_rows(rows: Mapping[str, Array], duplicates: str) -> Kept:
    """The rows of a log that are kept: one of each user, time and choice, with a finite reward.

    Args:
        rows: (N,) columns in order of user, time and choice: `user`, `timestamp`, `item` (or
            `action`, (N, A)), `reward`, `row` (position in the log) and perhaps those that break
            ties.
        duplicates: key of `DUPLICATES`.
    """
    rewards = rows[schema.REWARD]
    good = np.abs(rewards) <= MAX_FLOAT
    kept = np.ones(len(rewards), dtype=bool)
    same = same_key(rows)
    lost = conflicts = 0
    if same.any():
        repeated = np.zeros(len(rewards), dtype=bool)
        repeated[1:] |= same
        repeated[:-1] |= same
        places = np.flatnonzero(repeated)
        # Rows that agree with the one before are of its group.
        groups = np.cumsum(~np.concatenate([[False], same])[places])
        some = {name: values[places] for name, values in rows.items()}
        order = np.lexsort([*_tie_breakers(some), _rule(some, duplicates), ~good[places], groups])
        ordered = groups[order]
        begins = np.concatenate([[True], ordered[1:] != ordered[:-1]])
        winner = order[begins][np.cumsum(begins) - 1]
        losers = order[~begins]
        kept[places[losers]] = False
        ours, theirs = some["reward"][losers], some["reward"][winner[~begins]]
        equal = (ours == theirs) | (np.isnan(ours) & np.isnan(theirs))
        lost, conflicts = len(losers), int(np.count_nonzero(~equal))
    undefined = int(np.count_nonzero(kept & ~good))
    return Kept(np.flatnonzero(kept & good), lost, conflicts, undefined)


def kept_in_order(rows: Mapping[str, Array], duplicates: str) -> IntArray:
    """(K,) positions of the rows of a log in memory that are kept, in order of user and time.

    Args:
        rows: (N,) columns as of `kept_rows`, in any order; `item` holds numbers or text.
        duplicates: key of `DUPLICATES`.
    """
    users, times = rows["user"], rows[schema.TIMESTAMP]
    order = np.lexsort((times, users))
    apart = (np.diff(times[order]) > 0) | (np.diff(users[order]) != 0)
    if apart.all():
        return np.asarray(order[np.abs(rows[schema.REWARD][order]) <= MAX_FLOAT])
    items = rows[schema.ITEM]
    if items.dtype == object:
        items = np.unique(items, return_inverse=True)[1]
    order = np.lexsort((items, times, users))
    rows = {**rows, schema.ITEM: items}
    return order[kept_rows({name: values[order] for name, values in rows.items()}, duplicates).rows]


def same_key(rows: Mapping[str, Array]) -> BoolArray:
    """(N − 1,) whether each row but the first has the user, time and choice of the row before."""
    user, times = rows["user"], rows[schema.TIMESTAMP]
    same = (user[1:] == user[:-1]) & (times[1:] == times[:-1])
    choice = rows[schema.ITEM] if schema.ITEM in rows else rows[schema.ACTION]
    equal = choice[1:] == choice[:-1]
    return np.asarray(same & (equal if equal.ndim == 1 else equal.all(axis=1)))


def _rule(some: Mapping[str, Array], duplicates: str) -> Array:
    """Sort key by which the row that the rule keeps comes first."""
    rewards = some[schema.REWARD]
    if duplicates == "highest":
        return np.where(np.isnan(rewards), -np.inf, -rewards)
    if duplicates == "lowest":
        return rewards
    return some["row"] if duplicates == "first" else -some["row"]


def _tie_breakers(some: Mapping[str, Array]) -> list[Array]:
    """Sort keys of the other columns, the least important first, as `numpy.lexsort` wants them."""
    keys: list[Array] = []
    for name in _TIE_BREAKERS:
        if name in some:
            keys += list(some[name].T) if some[name].ndim == 2 else [some[name]]
    return keys[::-1]
