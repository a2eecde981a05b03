"""The SQL that reads, checks and de-duplicates log rows: shared by `prepare` and `recommend`."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import duckdb

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.binding import (
    MAX_FLOAT,
    Table,
    bind,
    explained,
    is_integer,
    is_number,
    is_vector,
    open_tables,
    text,
    wrong_type,
)
from ucfrec.logs.mapping import OPTIONAL_COLUMNS, LogMapping

EARLIEST_MS: Final = 946_684_800_000
"""2000-01-01 UTC: earlier rows come from a clock that is wrong."""
DAY_MS: Final = 86_400_000

REASONS: Final = {
    "null_key": "user, item or action, time or session is missing",
    "clock_out_of_range": "time before 2000 or more than a day ahead of now",
    "vector_not_finite": "action or observation is missing or holds NaN or infinity",
    "unknown_item": "item is none of the store's",
    "duplicate": "repeats the user, item or action, and time of a row that is kept",
    "reward_not_finite": "reward is missing, NaN or infinite",
}
"""Why rows are dropped; each row for the first reason that applies."""


@contextmanager
def engine(memory_limit: str, folder: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    """A DuckDB that works on disk.

    Args:
        memory_limit: e.g. "2GB".
        folder: where it keeps its files until the end.

    Raises:
        InputError: the limit is not a size.
    """
    with TemporaryDirectory(prefix=".ucfrec-", dir=folder) as work:
        connection = duckdb.connect(str(Path(work) / "rows.duckdb"))
        try:
            connection.execute(f"SET temp_directory = '{work}/spill'")
            try:
                connection.execute("SET memory_limit = ?", [memory_limit])
            except duckdb.Error:
                raise InputError(f"memory_limit {memory_limit!r}: write e.g. 2GB") from None
            _settle(connection)
            yield connection
        finally:
            connection.close()


@contextmanager
def engine_in_memory() -> Iterator[duckdb.DuckDBPyConnection]:
    """A DuckDB that never touches the disk."""
    connection = duckdb.connect(":memory:", config={"temp_directory": ""})
    try:
        _settle(connection)
        yield connection
    finally:
        connection.close()


def _settle(connection: duckdb.DuckDBPyConnection) -> None:
    """What expressions mean, the same in every engine and on every machine."""
    connection.execute("SET enable_progress_bar = false")
    connection.execute("SET error_on_division_by_zero = false")
    # Times with a zone are cast to times without one in this zone.
    connection.execute("SET TimeZone = 'UTC'")
    # SQL's own least(x, 5) is 5 where x is NULL, NaN or infinite: a video of unknown length
    # would count as watched five times. Undefined parts make a reward undefined instead.
    for name, sign in (("least", "<"), ("greatest", ">")):
        connection.execute(
            f"CREATE TEMP MACRO {name}(a, b) AS CASE WHEN isfinite(a::DOUBLE) AND "
            f"isfinite(b::DOUBLE) THEN CASE WHEN a {sign} b THEN a ELSE b END END, "
            f"(a, b, c) AS {name}({name}(a, b), c)"
        )


@dataclass(frozen=True)
class CleanLog:
    """A log whose rows lie checked in the table `rows` of `connection`, in file order.

    `rows` has the log columns of `columns`, `reward`, `row` (its place in the files), `reason`
    (why the row is dropped, NULL for rows to keep) and `conflict` (of duplicates: their reward is
    another than that of the row kept). The rows kept are the view `clean`.
    """

    connection: duckdb.DuckDBPyConnection
    tables: tuple[Table, ...]
    columns: tuple[str, ...]
    """Log columns present, `user_id` first."""
    vector_size: dict[str, int]
    """Size of `action` and `observation`, where present."""
    session_by: str
    """"session_id", "gap" or "user"."""

    @property
    def key(self) -> str:
        """`item_id` or `action`."""
        return schema.ITEM_ID if schema.ITEM_ID in self.columns else schema.ACTION

    @property
    def payload(self) -> tuple[str, ...]:
        """Columns beyond user, key and time."""
        return tuple(c for c in self.columns if c not in (schema.USER_ID, self.key, "timestamp"))

    def id_type(self, name: str) -> str:
        """DuckDB type of an id column: BIGINT or VARCHAR."""
        return str(self.one(f"SELECT typeof({name}) FROM rows LIMIT 1")[0])

    def one(self, sql: str) -> tuple[Any, ...]:
        """The single row that `sql` gives."""
        row: tuple[Any, ...] = self.connection.sql(sql).fetchall()[0]
        return row


def read_log(
    connection: duckdb.DuckDBPyConnection,
    files: Sequence[Path],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    known_items: Path | None,
    folder: Path,
) -> CleanLog:
    """Read and check every row of `files`.

    Of rows that repeat a key (user, item or action, time) the one with the highest reward is kept
    (feedback that came late adds to an impression), ties broken by the other columns, so that the
    order of rows and files does not matter.

    Args:
        reward: scalar SQL expression over the files' columns.
        session_by: "session_id", "gap" or "user"; None for session_id where there is one, or gap.
        known_items: a store's `items.parquet`, whose items alone are kept.
        folder: named when its disk is full.

    Raises:
        InputError: a file, column or type makes the log unusable.
    """
    tables = tuple(open_tables(connection, files))
    return judge_rows(connection, tables, mapping, reward, session_by, known_items, folder)


def judge_rows(
    connection: duckdb.DuckDBPyConnection,
    tables: tuple[Table, ...],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    known_items: Path | None,
    folder: Path,
) -> CleanLog:
    """`read_log` of tables that are open already."""
    columns = _present(tables, mapping, session_by)
    selects = [_select(connection, table, mapping, columns, reward) for table in tables]
    with explained(connection, tables, folder):
        for name in (schema.USER_ID, schema.ITEM_ID, schema.SESSION_ID):
            _unify_ids(selects, name)
        union = " UNION ALL ".join(
            f"SELECT {', '.join(f'{sql} AS {name}' for name, (sql, _) in select.items())} "
            f"FROM {table.sql}"
            for select, table in zip(selects, tables, strict=True)
        )
        connection.execute(
            f"CREATE TABLE read AS SELECT row_number() OVER () AS row, * FROM ({union})"
        )
        sizes = _vector_sizes(connection, columns)
        by = session_by or (schema.SESSION_ID if schema.SESSION_ID in columns else "gap")
        log = CleanLog(connection, tables, columns, sizes, by)
        connection.execute(_checked(log, known_items))
        connection.execute("DROP TABLE read")
        connection.execute(
            "CREATE VIEW clean AS SELECT * EXCLUDE (reason, conflict) FROM rows "
            "WHERE reason IS NULL"
        )
    return log


def _present(
    tables: Sequence[Table], mapping: LogMapping, session_by: str | None
) -> tuple[str, ...]:
    """Log columns of the files; required ones are always listed, binding explains a missing one."""
    named = {name: value for name, value in mapping.columns.items() if value}
    switched_off = mapping.columns.keys() - named.keys()
    everywhere = set.intersection(*({c.casefold() for c in t.columns} for t in tables))
    present = (set(named) | everywhere) - switched_off
    if session_by == schema.SESSION_ID:
        present.add(session_by)
    if schema.ACTION in named or (schema.ACTION in present and schema.ITEM_ID not in present):
        key = schema.ACTION
    else:
        key = schema.ITEM_ID
    optional = (name for name in OPTIONAL_COLUMNS if name in present)
    return (schema.USER_ID, key, schema.TIMESTAMP, *optional)


Select = dict[str, tuple[str, str]]
"""Log column to (SQL, DuckDB type)."""


def _select(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    mapping: LogMapping,
    columns: tuple[str, ...],
    reward: str,
) -> Select:
    select: Select = {}
    for name in columns:
        given = mapping.columns.get(name) or name
        what = f"for {name}; map it with --column {name}=..."
        select[name] = _typed(table, name, given, *bind(connection, table, what, given))
    sql, kind = bind(connection, table, "for the reward", reward)
    if not (is_number(kind) or kind == "BOOLEAN"):
        raise wrong_type(table, "reward", reward, kind, "give an expression that is a number")
    # A fault in one row (division by zero, a cast) makes that row's reward undefined, no more.
    select[schema.REWARD] = (f"TRY(CAST({sql} AS DOUBLE))", "DOUBLE")
    return select


def _typed(table: Table, name: str, given: str, sql: str, kind: str) -> tuple[str, str]:
    """SQL that brings a column to the type of the schema, and its type."""
    if name in (schema.USER_ID, schema.ITEM_ID, schema.SESSION_ID):
        if is_integer(kind) or kind in ("VARCHAR", "UUID"):
            return sql, kind
        wanted = f"use integers or text, e.g. --column {name}='{given}::BIGINT'"
    elif name == schema.TIMESTAMP:
        if is_number(kind):
            return f"TRY_CAST(round({sql}) AS BIGINT)", "BIGINT"
        if kind.startswith("TIMESTAMP") or kind == "DATE":
            return f"TRY(epoch_ms({sql}::TIMESTAMP))", "BIGINT"
        wanted = "use milliseconds, a date or a timestamp, e.g. --column timestamp='seconds * 1000'"
    elif name in (schema.ACTION, schema.OBSERVATION):
        if is_vector(kind):
            return f"TRY_CAST({sql} AS FLOAT[])", "FLOAT[]"
        wanted = f"use a list of numbers, e.g. --column {name}='{given}::FLOAT[]'"
    elif name == schema.PROPENSITY:
        if is_number(kind):
            good = f"{sql} > 0 AND {sql} <= {MAX_FLOAT}"
            return f"CAST(CASE WHEN {good} THEN {sql} END AS FLOAT)", "FLOAT"
        wanted = "use a number above 0"
    else:
        if is_number(kind) or kind == "BOOLEAN":
            return f"coalesce(CAST({sql} AS BOOLEAN), false)", "BOOLEAN"
        wanted = "use a boolean or 0 and 1"
    raise wrong_type(table, name, given, kind, wanted)


def _unify_ids(selects: list[Select], name: str) -> None:
    """Ids are BIGINT where every file has such, text otherwise; session ids only order rows."""
    if name not in selects[0]:
        return
    wide = {"UBIGINT", "HUGEINT", "UHUGEINT"}
    kinds = {select[name][1] for select in selects}
    whole = all(is_integer(kind) and kind not in wide for kind in kinds)
    for select in selects:
        select[name] = (f"CAST({select[name][0]} AS {'BIGINT' if whole else 'VARCHAR'})", "")


def _vector_sizes(
    connection: duckdb.DuckDBPyConnection, columns: tuple[str, ...]
) -> dict[str, int]:
    sizes: dict[str, int] = {}
    for name in (schema.ACTION, schema.OBSERVATION):
        if name not in columns:
            continue
        counts = connection.sql(
            f"SELECT len({name}) AS size, count(*) AS n FROM read WHERE {name} IS NOT NULL "
            "GROUP BY size ORDER BY n DESC, size LIMIT 4"
        ).fetchall()
        if len(counts) > 1:
            lengths = ", ".join(f"{n} rows of {size}" for size, n in counts)
            raise InputError(f"{name} has lists of unequal length: {lengths}; make them equal")
        if not counts or counts[0][0] == 0:
            raise InputError(f"{name} has no values in any row; map another column or none")
        sizes[name] = int(counts[0][0])
    return sizes


def _checked(log: CleanLog, known_items: Path | None) -> str:
    keys = [schema.USER_ID, log.key, schema.TIMESTAMP]
    keys += [schema.SESSION_ID] if log.session_by == schema.SESSION_ID else []
    missing = " OR ".join(f"{k} IS NULL" for k in keys if k != schema.ACTION)
    bad_vector = " OR ".join(
        f"{name} IS NULL OR NOT list_bool_and([coalesce(isfinite(v), false) FOR v IN {name}])"
        for name in log.vector_size
    )
    unknown = "false"
    if known_items is not None:
        known = f"SELECT CAST(item_id AS VARCHAR) FROM read_parquet({text(str(known_items))})"
        unknown = f"CAST({log.key} AS VARCHAR) NOT IN ({known})"
    latest = int(time.time() * 1000) + DAY_MS
    order = ", ".join(("good DESC", f"{schema.REWARD} DESC", *log.payload))
    return f"""
        CREATE TABLE rows AS
        WITH faults AS (
            SELECT *, CASE
                WHEN {missing} THEN 'null_key'
                WHEN {schema.TIMESTAMP} NOT BETWEEN {EARLIEST_MS} AND {latest}
                    THEN 'clock_out_of_range'
                WHEN {bad_vector or "false"} THEN 'vector_not_finite'
                WHEN {unknown} THEN 'unknown_item'
            END AS fault,
            coalesce(abs({schema.REWARD}) <= {MAX_FLOAT}, false) AS good
            FROM read
        ), ranked AS (
            SELECT *, row_number() OVER w AS rank,
                first_value({schema.REWARD}) OVER w AS kept_reward
            FROM faults WINDOW w AS (
                PARTITION BY fault, {schema.USER_ID}, {log.key}, {schema.TIMESTAMP}
                ORDER BY {order}
            )
        )
        SELECT * EXCLUDE (fault, good, rank, kept_reward), CASE
            WHEN fault IS NOT NULL THEN fault
            WHEN rank > 1 THEN 'duplicate'
            WHEN NOT good THEN 'reward_not_finite'
        END AS reason,
        fault IS NULL AND {schema.REWARD} IS DISTINCT FROM kept_reward AS conflict
        FROM ranked
    """
