"""A log as one relation of typed rows: its files, its columns, its reward."""

import warnings
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import duckdb

from ucfrec import schema
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.binding import Bound, bind, explained, wrong_type
from ucfrec.logs.engine import rows_of_batch
from ucfrec.logs.expressions import NotScalarError, columns_of
from ucfrec.logs.mapping import OPTIONAL_COLUMNS, LogMapping
from ucfrec.logs.tables import (
    MAX_FLOAT,
    NOTHING,
    Table,
    as_timestamp,
    first_and_more,
    is_integer,
    is_number,
    is_vector,
    quoted,
    raw_name,
)
from ucfrec.logs.times import text_time
from ucfrec.logs.vectors import (
    observation_counts,
    require_observations,
    vector_counts,
    vector_sizes,
    vectors,
)

ROWS: Final = "read"
"""Relation of `TypedLog`."""
WANTED: Final = "wanted"
"""Its column of whether a row fulfils the condition of `LogMapping.where`, if there is one."""


@dataclass(frozen=True)
class TypedLog:
    """A log whose rows, unchecked, are the relation `read` of `connection`.

    `read` has the log columns of `columns` in the types of the schema, `reward` (DOUBLE) and `row`
    (position in the files, from 1).
    """

    connection: duckdb.DuckDBPyConnection
    tables: tuple[Table, ...]
    columns: tuple[str, ...]
    """Log columns that the files have, `user_id` first."""
    vector_size: dict[str, int]
    """Dimensions of `action` and `observation`, if the log has them."""
    session_by: str
    """"session_id", "gap" or "user"."""
    earliest_ms: int
    """Rows with an earlier time (ms) are dropped as clock errors."""
    has_condition: bool
    """Whether its rows have the column `WANTED`."""

    @property
    def key(self) -> str:
        """Column of the choice: `item_id` or `action`."""
        return schema.ITEM_ID if schema.ITEM_ID in self.columns else schema.ACTION

    @property
    def batch_rows(self) -> int:
        """Rows of a batch of its rows."""
        return rows_of_batch(sum(self.vector_size.values()))

    @property
    def name(self) -> str:
        """The first file, and how many more there are, for messages."""
        return first_and_more([file for table in self.tables for file in table.files])

    def id_type(self, name: str) -> str:
        """DuckDB type of an id column: BIGINT or VARCHAR."""
        return str(self.one(f"DESCRIBE SELECT {name} FROM {ROWS}")[1])

    def one(self, sql: str) -> tuple[Any, ...]:
        """The first row of the result of `sql`."""
        row: tuple[Any, ...] = self.connection.sql(sql).fetchall()[0]
        return row


@dataclass(frozen=True)
class TypedColumns:
    """SQL of the typed columns of a log."""

    names: tuple[str, ...]
    """Log columns that the files have, `user_id` first."""
    selects: tuple[str, ...]
    """For each table of the log, the values of these columns and of `reward`, as after SELECT."""
    tables: tuple[Table, ...]
    """The tables with no other columns than these values need."""
    session_by: str
    """"session_id", "gap" or "user"."""

    def log(
        self,
        connection: duckdb.DuckDBPyConnection,
        vector_size: dict[str, int],
        mapping: LogMapping,
    ) -> TypedLog:
        """The log of these columns, whose rows `connection` has."""
        return TypedLog(
            connection,
            self.tables,
            self.names,
            vector_size,
            self.session_by,
            mapping.earliest_ms,
            mapping.where is not None,
        )


def typed_columns(
    connection: duckdb.DuckDBPyConnection,
    tables: tuple[Table, ...],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    as_text: Collection[str] = (),
) -> TypedColumns:
    """Resolve the columns and the reward of a log; the arguments are those of `typed_log`.

    Optional columns that only some of the files have are excluded, with an `InputNote`.

    Raises:
        InputError: a column is missing or of an unsupported type, or an expression cannot be used.
    """
    columns = _present(tables, mapping, session_by)
    _note_partial(tables, {*columns, *mapping.columns})
    found = [_select(connection, table, mapping, columns, reward) for table in tables]
    for name in (schema.USER_ID, schema.ITEM_ID, schema.SESSION_ID):
        if name in columns:
            _unify_ids(connection, found, name, name in as_text)
    return TypedColumns(
        columns,
        tuple(
            ", ".join(f"{sql} AS {name}" for name, (sql, _) in select.values.items())
            for select in found
        ),
        tuple(select.table for select in found),
        session_by or (schema.SESSION_ID if schema.SESSION_ID in columns else "gap"),
    )


def numbered_rows(given: Iterable[tuple[str, str]]) -> str:
    """SQL of typed rows with `row`, their position from 1.

    Args:
        given: for each table, values as of `TypedColumns.selects` and the SQL of the table.
    """
    union = " UNION ALL ".join(f"SELECT {values} FROM {table}" for values, table in given)
    return f"SELECT row_number() OVER () AS row, * FROM ({union})"


def typed_log(
    connection: duckdb.DuckDBPyConnection,
    tables: tuple[Table, ...],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
    folder: Path,
    as_text: Collection[str] = (),
) -> TypedLog:
    """Create `read` from tables that are open.

    Args:
        tables: of the log's files.
        mapping: log columns to the files' columns.
        reward: scalar SQL expression over the files' columns.
        session_by: "session_id", "gap" or "user"; None for session_id if the log has it, else gap.
        folder: folder named when its disk is full.
        as_text: id columns that are text even if all of them are integers.

    Raises:
        InputError: a file, column or type makes the log unusable, or an observation is missing or
            not finite.
    """
    typed = typed_columns(connection, tables, mapping, reward, session_by, as_text)
    with explained(connection, tables, folder):
        # Columns of Parquet files are read as often as they are needed; text is parsed once.
        columnar = all(table.columnar for table in tables)
        rows = numbered_rows(zip(typed.selects, (t.sql for t in typed.tables), strict=True))
        connection.execute(f"CREATE {'VIEW' if columnar else 'TABLE'} {ROWS} AS {rows}")
        counts = {
            name: dict(connection.sql(vector_counts(name, ROWS)).fetchall())
            for name in vectors(typed.names)
        }
        bad, n_rows = 0, 0
        if schema.OBSERVATION in counts:
            bad, n_rows = connection.sql(observation_counts(ROWS)).fetchall()[0]
    sizes = vector_sizes(counts)
    require_observations(tables, bad, n_rows)
    return typed.log(connection, sizes, mapping)


def _present(
    tables: Sequence[Table], mapping: LogMapping, session_by: str | None
) -> tuple[str, ...]:
    """Log columns that every file has, and the required ones, which `bind` reports if missing."""
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


def _note_partial(tables: Sequence[Table], settled: set[str]) -> None:
    """Warn of optional columns that some files have and others do not.

    Args:
        settled: columns that every file has, and those that the mapping names.
    """
    have = {name: _files_with(tables, name) for name in OPTIONAL_COLUMNS if name not in settled}
    every = sum(len(table.files) for table in tables)
    for name, files in have.items():
        if files:
            warnings.warn(
                f"{name} is excluded: only {len(files)} of {every} files have it ({files[0]}); add "
                f"it to the others, or drop it with --column {name}=",
                InputNote,
                stacklevel=4,
            )


def _files_with(tables: Sequence[Table], name: str) -> list[Path]:
    named = (t for t in tables if name in {column.casefold() for column in t.columns})
    return [file for table in named for file in table.files]


@dataclass(frozen=True)
class _Select:
    """The typed columns of one table."""

    table: Table
    """With the columns that are read."""
    values: dict[str, tuple[str, str]]
    """Log column to its (SQL, DuckDB type)."""


def _select(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    mapping: LogMapping,
    columns: tuple[str, ...],
    reward: str,
) -> _Select:
    given = {name: mapping.columns.get(name) or name for name in columns}
    bound = {
        name: bind(connection, table, f"for {name}; map it with --column {name}=...", each)
        for name, each in given.items()
    }
    # The text of a CSV file is what its identifiers and times are, not what DuckDB makes of it.
    raw = {
        name: each.columns[0]
        for name, each in bound.items()
        if not table.columnar and each.is_column and each.columns[0] in dict(table.types)
        if name in _IDS or (name == schema.TIMESTAMP and mapping.time_format)
    }
    for name, column in raw.items():
        bound[name] = Bound(quoted(raw_name(column)), "VARCHAR", (), False)
    table, of_reward = _reward(connection, table, reward)
    read = [*bound.values(), of_reward]
    if mapping.where is not None:
        condition = bind(connection, table, "for --where", mapping.where)
        if condition.kind != "BOOLEAN":
            wanted = "write a condition, e.g. user_id <> 'bot'"
            raise wrong_type(table, "--where", mapping.where, condition.kind, wanted)
        read.append(condition)
    used = (column for each in read for column in each.columns)
    narrow = table.of(used, raw.values())
    values = {
        name: _typed(connection, narrow, name, given[name], each, mapping.time_format)
        for name, each in bound.items()
    }
    sql, kind, *_ = of_reward
    if not (is_number(kind) or kind in ("BOOLEAN", NOTHING)):
        wanted = "use a number or truth value, such as try_cast(COLUMN AS DOUBLE) or COLUMN = 'yes'"
        raise wrong_type(table, "reward", reward, kind, wanted)
    # An error in one row (division by zero, a cast) makes only that row's reward undefined.
    values[schema.REWARD] = (f"TRY(CAST({sql} AS DOUBLE))", "DOUBLE")
    if mapping.where is not None:
        values[WANTED] = (f"coalesce(TRY({condition.sql}), false)", "BOOLEAN")
    return _Select(narrow, values)


def _reward(
    connection: duckdb.DuckDBPyConnection, table: Table, reward: str
) -> tuple[Table, Bound]:
    """The reward, and the table in which a column of text without a value has no type."""
    try:
        return table, bind(connection, table, "for the reward", reward)
    except InputError:
        empty = _empty_words(connection, table, reward)
        if not empty:
            raise
        kinds = ((name, NOTHING if name in empty else kind) for name, kind in table.types)
        table = replace(table, types=tuple(kinds))
        return table, bind(connection, table, "for the reward", reward)


def _empty_words(connection: duckdb.DuckDBPyConnection, table: Table, given: str) -> set[str]:
    """Columns of text without a value that an expression reads."""
    try:
        read = {name.casefold() for name in columns_of(connection, given)}
    except NotScalarError:
        return set()
    words = [n for n, kind in table.types if kind == "VARCHAR" and n.casefold() in read]
    if not words:
        return set()
    counts = ", ".join(f"count({quoted(name)})" for name in words)
    (row,) = connection.sql(f"SELECT {counts} FROM {table.of(words).sql}").fetchall()
    return {name for name, count in zip(words, row, strict=True) if not count}


_NOT_AN_INTEGER: Final = "CAST(TRY_CAST(x AS BIGINT) AS VARCHAR) IS DISTINCT FROM x"
"""SQL of whether a text `x` is not as the integer that it means is written."""
_IDS: Final = (schema.USER_ID, schema.ITEM_ID, schema.SESSION_ID)
_TYPES: Final = {
    **dict.fromkeys(_IDS, "VARCHAR"),
    schema.TIMESTAMP: "BIGINT",
    schema.ACTION: "FLOAT[]",
    schema.OBSERVATION: "FLOAT[]",
    schema.PROPENSITY: "FLOAT",
    schema.IS_RANDOM: "BOOLEAN",
}


def _typed(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    name: str,
    given: str,
    bound: Bound,
    time_format: str | None,
) -> tuple[str, str]:
    """SQL that casts a column to its type in the schema, and that DuckDB type."""
    sql, kind = bound.sql, bound.kind
    nothing = "false" if name == schema.IS_RANDOM else f"CAST(NULL AS {_TYPES[name]})"
    if kind == NOTHING:
        return nothing, NOTHING
    if name in _IDS:
        if is_integer(kind) or kind in ("VARCHAR", "UUID"):
            return sql, kind
        wanted = f"use integers or text, e.g. --column {name}='({given})::BIGINT'"
        if is_number(kind):
            wanted += ", if all are whole numbers of at most 15 digits: others would be rounded"
    elif name == schema.TIMESTAMP:
        if is_number(kind) and time_format is None:
            return f"TRY_CAST(round({sql}) AS BIGINT)", "BIGINT"
        if is_number(kind):
            digits = f"CAST(TRY_CAST({sql} AS BIGINT) AS VARCHAR)"
            return text_time(connection, table, digits, given, time_format), "BIGINT"
        if time := as_timestamp(sql, kind):
            return f"TRY(epoch_ms({time}))", "BIGINT"
        if kind == "VARCHAR":
            return text_time(connection, table, sql, given, time_format), "BIGINT"
        wanted = "use milliseconds, a date or a timestamp, e.g. --column timestamp='seconds * 1000'"
    elif name in (schema.ACTION, schema.OBSERVATION):
        if is_vector(kind):
            return f"TRY_CAST({sql} AS FLOAT[])", "FLOAT[]"
        wanted = f"use a list of numbers, e.g. --column {name}='{given}::FLOAT[]'"
    elif name == schema.PROPENSITY:
        if is_number(kind):
            # Numbers that are not above 0 stay, to be counted and refused.
            valid = f"{sql} BETWEEN -{MAX_FLOAT} AND {MAX_FLOAT}"
            return f"TRY(CAST(CASE WHEN {valid} THEN {sql} END AS FLOAT))", "FLOAT"
        wanted = "use a number above 0"
    else:
        if is_number(kind) or kind == "BOOLEAN":
            return f"coalesce(TRY(CAST({sql} AS DOUBLE)) = 1, false)", "BOOLEAN"
        wanted = "use a boolean or 0 and 1"
    # A part without any value has whatever type its writer gave it.
    if not connection.sql(f"SELECT 1 FROM {table.sql} WHERE {sql} IS NOT NULL LIMIT 1").fetchall():
        return nothing, NOTHING
    raise wrong_type(table, name, given, kind, wanted)


def _unify_ids(
    connection: duckdb.DuckDBPyConnection, found: list[_Select], name: str, as_text: bool
) -> None:
    """Cast ids to BIGINT if every file has integers that fit, else or with `as_text` to text.

    Text of a CSV file is an integer only if it is written as the integer is: 007, 7.0 and 1e1 are
    not.
    """
    whole = not as_text and all(
        kind == NOTHING
        or (is_integer(kind) and kind not in ("UBIGINT", "HUGEINT", "UHUGEINT"))
        or _are_integers(connection, each.table, sql)
        for each in found
        for sql, kind in [each.values[name]]
    )
    if not whole:
        _note_decimals(connection, found, name)
    for each in found:
        sql, _ = each.values[name]
        # Text without a character is missing, as in a CSV file.
        typed = f"CAST({sql} AS BIGINT)" if whole else f"nullif(CAST({sql} AS VARCHAR), '')"
        each.values[name] = (typed, "")


def _are_integers(connection: duckdb.DuckDBPyConnection, table: Table, sql: str) -> bool:
    """Whether a column is text of a CSV file, and all of it is written as integers are."""
    if _csv_type(table, sql) is None:
        return False
    with explained(connection, (table,), table.files[0].parent):
        ((others,),) = connection.sql(
            f"SELECT bool_or({_NOT_AN_INTEGER}) FROM (SELECT {sql} AS x FROM {table.sql}) "
            "WHERE x IS NOT NULL"
        ).fetchall()
    return not others


def _csv_type(table: Table, sql: str) -> str | None:
    """The type that DuckDB inferred for a column whose text is read; None for other columns."""
    kinds = dict(table.types)
    return next((kinds[name] for name in table.raw if quoted(raw_name(name)) == sql), None)


def _note_decimals(connection: duckdb.DuckDBPyConnection, found: list[_Select], name: str) -> None:
    """Warn of ids that are written as 7 and as 7.0, which are two ids."""
    decimal: list[Table] = []
    whole = False
    for each in found:
        sql, kind = each.values[name]
        kind = _csv_type(each.table, sql) or kind
        whole |= is_integer(kind)
        if kind == "DOUBLE":
            decimal.append(each.table)
            ((some,),) = connection.sql(
                f"SELECT coalesce(bool_or(NOT ({_NOT_AN_INTEGER})), false) "
                f"FROM (SELECT {sql} AS x FROM {each.table.sql})"
            ).fetchall()
            whole |= some
    if whole and decimal:
        warnings.warn(
            f"{name} is written as whole numbers and, in {decimal[0].files[0]}, with decimals: 7 "
            f"and 7.0 are two ids; to make them one, say --column {name}='COLUMN::BIGINT'",
            InputNote,
            stacklevel=5,
        )
