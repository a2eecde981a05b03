"""Which rows of a log can be used: the faults, the rule for duplicates, and both in one SQL query.

Logs in files are sorted and gone through in batches (`ucfrec.logs.sorted_rows`); logs in memory
are checked by one query, `check_rows`. Both keep the same rows.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import duckdb

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.binding import MAX_FLOAT, Table, explained, glob_pattern, text
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.typed import ROWS, TypedLog, not_finite, typed_log

EARLIEST_MS: Final = 946_684_800_000
"""2000-01-01 UTC in ms; rows with an earlier time are dropped as clock errors."""
DAY_MS: Final = 86_400_000
"""One day in ms."""

REASONS: Final = {
    "null_key": "user, item or action, time or session is missing",
    "clock_out_of_range": "time before 2000 or more than a day ahead of now",
    "vector_not_finite": "action is missing or holds NaN or infinity",
    "unknown_item": "item is not in the store",
    "duplicate": "repeats user, item or action, and time of another row, which is kept",
    "reward_not_finite": "reward is missing, NaN or infinite",
}
"""Reason to its description; a row is dropped for the first reason that applies."""


DUPLICATES: Final = {
    "highest": (f"{schema.REWARD} DESC", "has the highest"),
    "lowest": (f"{schema.REWARD}", "has the lowest"),
    "first": ("row", "comes first in the files"),
    "last": ("row DESC", "comes last in the files"),
}
"""Which of several rows with the same user, item or action, and time is kept: SQL of the order in
which the kept row is the first, and its description."""


def faults(log: TypedLog, known_items: Path | None = None) -> dict[str, str]:
    """Reason to the SQL condition on a row of `read`; the first that holds counts.

    Args:
        log: any.
        known_items: `items.parquet` of a store: other items are a fault; None for none.
    """
    keys = [schema.USER_ID, log.key, schema.TIMESTAMP]
    keys += [schema.SESSION_ID] if log.session_by == schema.SESSION_ID else []
    latest = int(time.time() * 1000) + DAY_MS
    conditions = {
        "null_key": " OR ".join(f"{k} IS NULL" for k in keys if k != schema.ACTION),
        "clock_out_of_range": f"{schema.TIMESTAMP} NOT BETWEEN {EARLIEST_MS} AND {latest}",
    }
    if schema.ACTION in log.vector_size:
        conditions["vector_not_finite"] = not_finite(schema.ACTION)
    if known_items is not None:
        source = f"read_parquet({text(glob_pattern(known_items))})"
        known = f"SELECT CAST(item_id AS VARCHAR) FROM {source}"
        conditions["unknown_item"] = f"CAST({log.key} AS VARCHAR) NOT IN ({known})"
    return conditions


def require_rewards_in_range(log: TypedLog, large: int, rows: int, largest: float) -> None:
    """Check the count of rewards beyond `LARGEST_REWARD`.

    Args:
        log: for the message.
        large: how many rewards are beyond it.
        rows: how many rewards there are.
        largest: the largest absolute reward.

    Raises:
        InputError: there are any.
    """
    if large:
        raise InputError(
            f"{log.tables[0].files[0]}: {large:,} of {rows:,} rewards are beyond "
            f"±{schema.LARGEST_REWARD:g} (up to {largest:.3g}), too large to train with in "
            "float32; divide them in the reward expression"
        )


def check_rows(
    connection: duckdb.DuckDBPyConnection,
    tables: tuple[Table, ...],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    folder: Path,
    duplicates: str = "highest",
) -> TypedLog:
    """Read and check every row of a log by one query.

    Creates the table `rows`, which is `read` with `reason` (key of `REASONS` for dropped rows, NULL
    for kept rows), and the view `clean` of the kept rows. Of rows with the same key (user, item or
    action, time) one is kept, by default that with the highest reward, because late feedback is
    logged as a second row of an impression. Ties are broken by the other columns, so that the order
    of rows and files does not matter.

    Args:
        connection: engine that may open the tables.
        tables: of the log.
        mapping: log columns to the tables' columns.
        reward: scalar SQL expression over the tables' columns.
        session_by: "session_id", "gap" or "user"; None for session_id if the log has it, else gap.
        folder: folder named when its disk is full.
        duplicates: key of `DUPLICATES`, which of several rows with the same key is kept.

    Raises:
        InputError: a file, column or type makes the log unusable, an observation is missing or not
            finite, a reward is too large to train with.
    """
    log = typed_log(connection, tables, mapping, reward, session_by, folder)
    with explained(connection, tables, folder):
        connection.execute(_checked(log, duplicates))
        connection.execute(
            "CREATE VIEW clean AS SELECT * EXCLUDE (reason) FROM rows WHERE reason IS NULL"
        )
        require_rewards_in_range(
            log,
            *log.one(
                f"SELECT count_if(abs({schema.REWARD}) > {schema.LARGEST_REWARD:.0f}), count(*), "
                f"max(abs({schema.REWARD})) FROM clean"
            ),
        )
    return log


def _checked(log: TypedLog, duplicates: str) -> str:
    cases = " ".join(f"WHEN {sql} THEN '{reason}'" for reason, sql in faults(log).items())
    order = ", ".join(("good DESC", DUPLICATES[duplicates][0], *log.payload))
    return f"""
        CREATE TABLE rows AS
        WITH faults AS (
            SELECT *, CASE {cases} END AS fault,
                coalesce(abs({schema.REWARD}) <= {MAX_FLOAT}, false) AS good
            FROM {ROWS}
        ), ranked AS (
            SELECT *, row_number() OVER (
                PARTITION BY fault, {schema.USER_ID}, {log.key}, {schema.TIMESTAMP}
                ORDER BY {order}
            ) AS rank
            FROM faults
        )
        SELECT * EXCLUDE (fault, good, rank), CASE
            WHEN fault IS NOT NULL THEN fault
            WHEN rank > 1 THEN 'duplicate'
            WHEN NOT good THEN 'reward_not_finite'
        END AS reason
        FROM ranked
    """


def drop_counts(log: TypedLog) -> dict[str, int]:
    """Number of dropped rows of the table `rows` for each of `REASONS`.

    Raises:
        InputError: every row is dropped.
    """
    counts = dict(
        log.connection.sql("SELECT reason, count(*) FROM rows GROUP BY reason").fetchall()
    )
    dropped = {reason: int(counts.get(reason, 0)) for reason in REASONS}
    require_rows(log, counts.get(None, 0), dropped)
    return dropped


def require_rows(log: TypedLog, kept: int, dropped: Mapping[str, int]) -> None:
    """Check that a row is left.

    Args:
        log: for the message.
        kept: number of rows that are.
        dropped: number of dropped rows by reason.

    Raises:
        InputError: none is.
    """
    if kept == 0:
        reasons = "; ".join(f"{n} rows: {REASONS[reason]}" for reason, n in dropped.items() if n)
        hint = "; is the time in milliseconds?" if dropped["clock_out_of_range"] else ""
        raise InputError(
            f"{log.name}: no row is left ({reasons}{hint}); correct the mapping or the log"
        )
