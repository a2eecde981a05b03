"""Which of a log's rows are faulty, which of the others stay, and in which order.

One rule for files, frames and requests.

Rows of one user at one time, such as a page that was logged at once or a log of days, have no order
that could be learned: theirs is that of a hash of user, time and item. Any other order, such as
that of the ids, is one that a policy predicts.
"""

import time
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import xxhash

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.mapping import EARLIEST_MS
from ucfrec.logs.tables import MAX_FLOAT, glob_pattern, text
from ucfrec.logs.typed import ROWS, WANTED, TypedLog
from ucfrec.logs.vectors import not_finite

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


Digests = npt.NDArray[np.uint64]
DAY_MS: Final = 86_400_000
"""One day in ms."""
REASONS: Final = {
    "left_out": "does not fulfil --where",
    "null_key": "user, item or action, time or session is missing",
    "clock_out_of_range": "time before 2000 (or --earliest, or the end of an updated store) or "
    "more than a day ahead of now",
    "vector_not_finite": "action is missing or holds NaN or infinity",
    "unknown_item": "item is not in the store",
    "duplicate": "repeats user, item or action, and time of another row, which is kept",
    "reward_not_finite": "reward is missing, NaN or infinite",
}
"""Reason to its description; a row is dropped for the first reason that applies."""
_FINE: Final = ("duplicate", "left_out")
FEW_IDS: Final = 20
MOST_UNKNOWN: Final = 0.9
"""Share of the users or items of a log, if they are `FEW_IDS` or more, from which on it is worth a
warning that they are unknown."""
CLOCK_HINT: Final = (
    "is the time in milliseconds? Seconds are read with --column timestamp='COLUMN * 1000', "
    "microseconds with 'COLUMN / 1000', nanoseconds with 'COLUMN / 1000000', times such as "
    "20260131 with --time-format; for older times, say --earliest 1990-01-01, or earliest in the "
    "mapping"
)


@dataclass(frozen=True)
class Hashes:
    """Hashes of the text of identifiers, so that 7 and '7' have one."""

    of_users: Callable[[Array], Digests]
    """Of the values (M,) of the column `user`."""
    of_items: Callable[[Array], Digests]
    """Of the values (M,) of the column `item`."""


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
    same = _same_key(rows)
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


def kept_in_order(
    rows: Mapping[str, Array], duplicates: str, user_id: int | str | None = None
) -> IntArray:
    """(K,) positions of the rows of a log in memory that are kept, in order of user and time.

    Args:
        rows: (N,) columns as of `kept_rows`, in any order; `item` holds identifiers, and so
            does `user` but for `user_id`.
        duplicates: key of `DUPLICATES`.
        user_id: the only user.
    """
    users, times = rows["user"], rows[schema.TIMESTAMP]
    order = np.lexsort((times, users))
    apart = (np.diff(times[order]) > 0) | (np.diff(users[order]) != 0)
    if apart.all():
        return np.asarray(order[np.abs(rows[schema.REWARD][order]) <= MAX_FLOAT])
    ids, items = np.unique(rows[schema.ITEM], return_inverse=True)
    order = np.lexsort((items, times, users))
    found = {name: values[order] for name, values in {**rows, schema.ITEM: items}.items()}
    one = None if user_id is None else digests([user_id])
    hashes = Hashes(
        lambda users: digests(users.tolist()) if one is None else one.repeat(len(users)),
        lambda items: digests(ids[items].tolist()),
    )
    return order[in_hashed_order(found, kept_rows(found, duplicates).rows, hashes)[0]]


def in_hashed_order(
    rows: Mapping[str, Array], kept: IntArray, hashes: Hashes
) -> tuple[IntArray, int]:
    """Put the rows of one user at one time in the order of a hash.

    Args:
        rows: as of `kept_rows`.
        kept: (K,) positions, in order, of the rows that are kept.

    Returns:
        (K,) the positions in the new order, and how many rows share their user and time.
    """
    users, times = rows["user"][kept], rows[schema.TIMESTAMP][kept]
    tied = (users[1:] == users[:-1]) & (times[1:] == times[:-1])
    if not tied.any():
        return kept, 0
    within = np.concatenate([[False], tied])
    places = np.flatnonzero(within | np.concatenate([tied, [False]]))
    groups = np.cumsum(~within)[places]
    if schema.ITEM in rows:
        key = hashes.of_items(rows[schema.ITEM][kept][places])
    else:
        key = np.zeros(len(places), dtype=np.uint64)
        for column in rows[schema.ACTION][kept][places].view(np.uint32).T:
            key = mixed(key + column)
    key = mixed(key + mixed(hashes.of_users(users[places]) + times[places].view(np.uint64)))
    ordered = kept.copy()
    ordered[places] = kept[places[np.lexsort((key, groups))]]
    return ordered, len(places)


def digests(ids: Sequence[object]) -> Digests:
    """A hash (N,) of the text of each identifier."""
    found = {each: _digest(str(each)) for each in dict.fromkeys(ids)}
    return np.asarray([found[each] for each in ids], dtype=np.uint64)


def _digest(text: str) -> int:
    # Text of JSON may hold half a character.
    return xxhash.xxh3_64_intdigest(text.encode("utf-8", "surrogatepass"))


def mixed(values: Digests) -> Digests:
    """The finaliser of SplitMix64: every bit of the result depends on all of a value, and different
    values have different results."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _same_key(rows: Mapping[str, Array]) -> BoolArray:
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


def faults(log: TypedLog, known_items: Path | None = None) -> dict[str, str]:
    """Reason to the SQL condition on a row of `read`; the first that holds counts.

    Args:
        known_items: `items.parquet` of a store: other items are a fault; None for none.
    """
    keys = [schema.USER_ID, log.key, schema.TIMESTAMP]
    keys += [schema.SESSION_ID] if log.session_by == schema.SESSION_ID else []
    latest = int(time.time() * 1000) + DAY_MS
    conditions = {"left_out": f"NOT {WANTED}"} if log.has_condition else {}
    conditions |= {
        "null_key": " OR ".join(f"{k} IS NULL" for k in keys if k != schema.ACTION),
        "clock_out_of_range": f"{schema.TIMESTAMP} NOT BETWEEN {log.earliest_ms} AND {latest}",
    }
    if schema.ACTION in log.vector_size:
        conditions["vector_not_finite"] = not_finite(schema.ACTION)
    if known_items is not None:
        source = f"read_parquet({text(glob_pattern(known_items))}, hive_partitioning = false)"
        known = f"SELECT CAST(item_id AS VARCHAR) FROM {source}"
        conditions["unknown_item"] = f"CAST({log.key} AS VARCHAR) NOT IN ({known})"
    return conditions


def require_rewards_in_range(log: TypedLog, large: int, rows: int, largest: float) -> None:
    """Check the count of rewards beyond `LARGEST_REWARD`.

    Raises:
        InputError: there are any.
    """
    if large:
        raise InputError(
            f"{log.tables[0].files[0]}: {large:,} of {rows:,} rewards are beyond "
            f"±{schema.LARGEST_REWARD:g} (up to {largest:.3g}), too large to train with in "
            "float32; divide them in the reward expression"
        )


def note_dropped(
    name: str, dropped: Mapping[str, int], read: int, fine: Collection[str] = _FINE
) -> None:
    """Warn of the rows that are left out, with their numbers and reasons; silent if none is.

    Args:
        name: of the data, for the message; empty for none.
        fine: reasons that need no warning of their own.
    """
    counts = {reason: n for reason, n in dropped.items() if n}
    if not counts.keys() - {*fine}:
        return
    total = sum(counts.values())
    reasons = "; ".join(f"{n:,}: {REASONS.get(reason, reason)}" for reason, n in counts.items())
    hint = f"; {CLOCK_HINT}" if "clock_out_of_range" in counts else ""
    origin = f"{name}: " if name else ""
    warnings.warn(
        f"{origin}{total:,} of {read:,} rows were excluded ({reasons}{hint})",
        InputNote,
        stacklevel=3,
    )


def note_unknown(name: str, column: str, unknown: int, total: int, known: str) -> None:
    """Warn where nearly all users or items of a log are unknown, as if written in another way.

    Args:
        name: of the log, for the message.
        column: `user_id` or `item_id`.
        unknown: number of its ids that are not known.
        total: number of its ids; few say nothing.
        known: whose ids are known, after "those".
    """
    if total < FEW_IDS or unknown < MOST_UNKNOWN * total:
        return
    ids = column.removesuffix("_id") + "s"
    warnings.warn(
        f"{name}: {unknown:,} of {total:,} {ids} are not among those {known}; if they should be, "
        f"compare how {column} is written",
        InputNote,
        stacklevel=3,
    )


class NoRowsError(InputError):
    """No row of a log can be used."""


def require_rows(
    log: TypedLog, kept: int, dropped: Mapping[str, int], onto: Path | None = None
) -> None:
    """Check that a row is left.

    Args:
        onto: a store that the log is added to, whose end is the earliest time; None for none.

    Raises:
        NoRowsError: none is.
    """
    if kept == 0:
        if onto is not None:
            _require_newer(log, dropped, onto)
        reasons = "; ".join(f"{n} rows: {REASONS[reason]}" for reason, n in dropped.items() if n)
        hint = f"; {CLOCK_HINT}" if dropped["clock_out_of_range"] else ""
        raise NoRowsError(
            f"{log.name}: no row is left ({reasons}{hint}); correct the mapping or the log"
        )


def _require_newer(log: TypedLog, dropped: Mapping[str, int], onto: Path) -> None:
    """Check that the rows of a log, none of which is left, are not just those of the store again.

    Raises:
        NoRowsError: all rows that are wanted have a sound time, which is not after the store.
    """
    wanted = sum(dropped.values()) - dropped["left_out"]
    if not wanted or dropped["clock_out_of_range"] < wanted:
        return
    (latest,) = log.one(f"SELECT max({schema.TIMESTAMP}) FROM {ROWS}")
    # Times before 2000 or in the future have another cause, such as seconds for milliseconds.
    if EARLIEST_MS <= latest < log.earliest_ms:
        last = datetime.fromtimestamp((log.earliest_ms - 1) / 1000, UTC)
        raise NoRowsError(
            f"{log.name}: all {wanted:,} rows are not newer than {onto}, whose last row is of "
            f"{last:%Y-%m-%d %H:%M:%S} UTC; give newer logs"
        )
