"""Which of a log's rows are faulty, which of the others stay, and in which order.

One rule for files, frames and requests.

Rows of one user at one time, such as a page that was logged at once or a log of days, have no order
that could be learned: theirs is that of a hash of user, time and item. Any other order, such as
that of the ids, is one that a policy predicts.
"""

import hashlib
import time
import warnings
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
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
PRIME: Final = 2**31 - 1
USER_FACTOR: Final = 7919
HASH: Final = "CAST(conv(substr(md5(CAST({} AS STRING)), 1, 7), 16, 10) AS BIGINT)"
"""SQL of `hash_ids`, for Spark and, where `conv` is a macro, for DuckDB."""
TIE: Final = f"((1 + ({{}} * {USER_FACTOR} + {{}}) % {PRIME - 1}) * (1 + {{}}) % {PRIME})"
"""SQL of the place of a row among those of one user and time, by the hash of the user, the time and
the hash of the item. Each user and time multiply by a number of their own, modulo a prime, so that
two items are as often in one order as in the other."""
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


def kept_in_order(
    rows: Mapping[str, Array], duplicates: str, user_id: int | str | None = None
) -> IntArray:
    """(K,) positions of the rows of a log in memory that count, in order of user and time.

    `ucfrec.logs.sorted_rows` says the same in SQL, of logs of any size.

    Args:
        rows: (N,) columns in any order: `user`, `timestamp`, `item` (identifiers), `reward`, `row`
            (position in the log) and perhaps those that break ties. `user` holds identifiers but
            for `user_id`.
        duplicates: key of `DUPLICATES`.
        user_id: the only user.
    """
    users, times, rewards = rows["user"], rows[schema.TIMESTAMP], rows[schema.REWARD]
    finite = np.abs(rewards) <= MAX_FLOAT
    order = np.lexsort((times, users))
    apart = (np.diff(times[order]) > 0) | (np.diff(users[order]) != 0)
    if apart.all():
        return np.asarray(order[finite[order]])
    tied = np.zeros(len(users), dtype=bool)
    tied[order[1:]] |= ~apart
    tied[order[:-1]] |= ~apart
    items, ties = np.zeros((2, len(users)), dtype=np.int64)
    ids, items[tied] = np.unique(rows[schema.ITEM][tied], return_inverse=True)
    names, places = np.unique(users[tied], return_inverse=True)
    of_users = hash_ids([user_id] * len(names) if user_id is not None else names.tolist())[places]
    multiplier = 1 + np.fmod(of_users * USER_FACTOR + times[tied], PRIME - 1)
    ties[tied] = np.fmod(multiplier * (1 + hash_ids(ids.tolist())[items[tied]]), PRIME)
    keys = [users, times, ties, items]
    order = np.lexsort([*order_duplicates(rows, duplicates), *keys[::-1]])
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
    return np.asarray(order[first & finite[order]])


def order_duplicates(rows: Mapping[str, Array], duplicates: str) -> list[Array]:
    """Keys for `numpy.lexsort` by which, of rows of one user, time and choice, the one that counts
    is the first.

    Args:
        rows: (N,) `reward`, `row` (position in the log) and those of `observation`, `propensity`,
            `session` and `is_random` that the log has, which decide between rows that are equal to
            the rule, so that the order of rows and files does not matter.
        duplicates: key of `DUPLICATES`.
    """
    rewards = rows[schema.REWARD]
    finite = np.abs(rewards) <= MAX_FLOAT
    rule = {"highest": -rewards, "lowest": rewards, "first": rows["row"], "last": -rows["row"]}
    keys = [~finite, np.where(finite, rule[duplicates], 0)]
    for name in (schema.OBSERVATION, schema.PROPENSITY, "session", schema.IS_RANDOM):
        if name in rows:
            keys += list(rows[name].T) if rows[name].ndim == 2 else [rows[name]]
    return keys[::-1]


def hash_ids(ids: Sequence[object]) -> IntArray:
    """A number (N,) below 2**28 of the text of each identifier, so that 7 and '7' have one.

    It is that of `HASH`.
    """
    # Text of JSON may hold half a character.
    texts = (str(identifier).encode("utf-8", "surrogatepass") for identifier in ids)
    digests = (hashlib.md5(text, usedforsecurity=False).hexdigest() for text in texts)
    return np.asarray([int(digest[:7], 16) for digest in digests], dtype=np.int64)


def mixed(values: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """The finaliser of SplitMix64: every bit of the result depends on all of a value, and different
    values have different results."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


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
        known_ids = f"SELECT CAST(item_id AS VARCHAR) FROM {source}"
        conditions["unknown_item"] = f"CAST({log.key} AS VARCHAR) NOT IN ({known_ids})"
    return conditions


def note_dropped(
    name: str, dropped: Mapping[str, int], n_read: int, fine: Collection[str] = _FINE
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
        f"{origin}{total:,} of {n_read:,} rows were excluded ({reasons}{hint})",
        InputNote,
        stacklevel=3,
    )


def note_unknown(name: str, column: str, unknown: int, total: int, known_ids: str) -> None:
    """Warn where nearly all users or items of a log are unknown, as if written in another way.

    Args:
        name: of the log, for the message.
        column: `user_id` or `item_id`.
        unknown: number of its ids that are not known.
        total: number of its ids; few say nothing.
        known_ids: whose ids are known, after "those".
    """
    if total < FEW_IDS or unknown < MOST_UNKNOWN * total:
        return
    ids = column.removesuffix("_id") + "s"
    warnings.warn(
        f"{name}: {unknown:,} of {total:,} {ids} are not among those {known_ids}; if they "
        f"should be, compare how {column} is written",
        InputNote,
        stacklevel=3,
    )


class NoRowsError(InputError):
    """No row of a log can be used."""


def require_rows(
    log: TypedLog, count: int, dropped: Mapping[str, int], onto: Path | None = None
) -> None:
    """Check that a row is left.

    Args:
        onto: a store that the log is added to, whose end is the earliest time; None for none.

    Raises:
        NoRowsError: none is.
    """
    if count == 0:
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
    n_wanted = sum(dropped.values()) - dropped["left_out"]
    if not n_wanted or dropped["clock_out_of_range"] < n_wanted:
        return
    (latest,) = log.one(f"SELECT max({schema.TIMESTAMP}) FROM {ROWS}")
    # Times before 2000 or in the future have another cause, such as seconds for milliseconds.
    if EARLIEST_MS <= latest < log.earliest_ms:
        last = datetime.fromtimestamp((log.earliest_ms - 1) / 1000, UTC)
        raise NoRowsError(
            f"{log.name}: all {n_wanted:,} rows are not newer than {onto}, whose last row is of "
            f"{last:%Y-%m-%d %H:%M:%S} UTC; give newer logs"
        )
