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
        how = self.session_by, mapping.earliest_ms, mapping.where is not None
        return TypedLog(connection, self.tables, self.names, vector_size, *how)


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
    selects = [_select(connection, table, mapping, columns, reward) for table in tables]
    for name in _IDS:
        if name in columns:
            _unify_ids(connection, selects, name, name in as_text)
    return TypedColumns(
        columns,
        tuple(", ".join(f"{s} AS {name}" for name, (s, _) in x.values.items()) for x in selects),
        tuple(select.table for select in selects),
        session_by or (schema.SESSION_ID if schema.SESSION_ID in columns else "gap"),
    )


def numbered_rows(selects: Iterable[tuple[str, str]]) -> str:
    """SQL of typed rows with `row`, their position from 1.

    Args:
        selects: for each table, values as of `TypedColumns.selects` and the SQL of the table.
    """
    union = " UNION ALL ".join(f"SELECT {values} FROM {table}" for values, table in selects)
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
    mapped = {name for name, value in mapping.columns.items() if value}
    everywhere = set.intersection(*({c.casefold() for c in t.columns} for t in tables))
    present = mapped | (everywhere - mapping.columns.keys())
    if session_by == schema.SESSION_ID:
        present.add(session_by)
    vectors_only = schema.ACTION in present and schema.ITEM_ID not in present
    key = schema.ACTION if schema.ACTION in mapped or vectors_only else schema.ITEM_ID
    optional = (name for name in OPTIONAL_COLUMNS if name in present)
    return (schema.USER_ID, key, schema.TIMESTAMP, *optional)


def _note_partial(tables: Sequence[Table], excluded: set[str]) -> None:
    """Warn of optional columns that some files have and others do not.

    Args:
        excluded: columns that every file has, and those that the mapping names.
    """
    count = sum(len(table.files) for table in tables)
    for name in [name for name in OPTIONAL_COLUMNS if name not in excluded]:
        having = [t for t in tables if name in {column.casefold() for column in t.columns}]
        files = [file for table in having for file in table.files]
        if files:
            warnings.warn(
                f"{name} is excluded: only {len(files)} of {count} files have it ({files[0]}); add "
                f"it to the others, or drop it with --column {name}=",
                InputNote,
                stacklevel=4,
            )


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
    texts = {name: mapping.columns.get(name) or name for name in columns}
    bound = {
        name: bind(connection, table, f"for {name}; map it with --column {name}=...", expression)
        for name, expression in texts.items()
    }
    # The text of a CSV file is what its identifiers and times are, not what DuckDB makes of it.
    raw = {
        name: value.columns[0]
        for name, value in bound.items()
        if not table.columnar and value.is_column and value.columns[0] in dict(table.types)
        if name in _IDS or (name == schema.TIMESTAMP and mapping.time_format)
    }
    for name, column in raw.items():
        bound[name] = Bound(quoted(raw_name(column)), "VARCHAR", (), False)
    table, reward_value = _bind_reward(connection, table, reward)
    if not (is_number(reward_value.kind) or reward_value.kind in ("BOOLEAN", NOTHING)):
        remedy = "use a number or truth value, such as try_cast(COLUMN AS DOUBLE) or COLUMN = 'yes'"
        raise wrong_type(table, "reward", reward, reward_value.kind, remedy)
    # An error in one row (division by zero, a cast) makes only that row's reward undefined.
    extra = {schema.REWARD: (f"TRY(CAST({reward_value.sql} AS DOUBLE))", "DOUBLE")}
    sources = [*bound.values(), reward_value]
    if mapping.where is not None:
        condition = bind(connection, table, "for --where", mapping.where)
        if condition.kind != "BOOLEAN":
            remedy = "write a condition, e.g. user_id <> 'bot'"
            raise wrong_type(table, "--where", mapping.where, condition.kind, remedy)
        extra[WANTED] = (f"coalesce(TRY({condition.sql}), false)", "BOOLEAN")
        sources.append(condition)
    narrow = table.of((column for value in sources for column in value.columns), raw.values())
    values = {
        name: _cast_value(connection, narrow, name, texts[name], value, mapping.time_format)
        for name, value in bound.items()
    }
    return _Select(narrow, {**values, **extra})


def _bind_reward(
    connection: duckdb.DuckDBPyConnection, table: Table, reward: str
) -> tuple[Table, Bound]:
    """The reward, and the table in which a column of text without a value has no type."""
    try:
        return table, bind(connection, table, "for the reward", reward)
    except InputError:
        try:
            names = {name.casefold() for name in columns_of(connection, reward)}
        except NotScalarError:
            names = set()
        texts = [n for n, kind in table.types if kind == "VARCHAR" and n.casefold() in names]
        if not texts:
            raise
        counts = ", ".join(f"count({quoted(name)})" for name in texts)
        (row,) = connection.sql(f"SELECT {counts} FROM {table.of(texts).sql}").fetchall()
        empty = {name: NOTHING for name, count in zip(texts, row, strict=True) if not count}
        if not empty:
            raise
        table = replace(table, types=tuple((dict(table.types) | empty).items()))
        return table, bind(connection, table, "for the reward", reward)


_IS_INTEGER: Final = "CAST(TRY_CAST(x AS BIGINT) AS VARCHAR) IS NOT DISTINCT FROM x"
"""SQL of whether a text `x` is as the integer that it means is written."""
_IDS: Final = (schema.USER_ID, schema.ITEM_ID, schema.SESSION_ID)
_TYPES: Final = {
    **dict.fromkeys(_IDS, "VARCHAR"),
    schema.TIMESTAMP: "BIGINT",
    schema.ACTION: "FLOAT[]",
    schema.OBSERVATION: "FLOAT[]",
    schema.PROPENSITY: "FLOAT",
    schema.IS_RANDOM: "BOOLEAN",
}


def _cast_value(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    name: str,
    expression: str,
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
        remedy = f"use integers or text, e.g. --column {name}='({expression})::BIGINT'"
        if is_number(kind):
            remedy += ", if all are whole numbers of at most 15 digits: others would be rounded"
    elif name == schema.TIMESTAMP:
        if is_number(kind) and time_format is None:
            return f"TRY_CAST(round({sql}) AS BIGINT)", "BIGINT"
        if is_number(kind):
            sql, kind = f"CAST(TRY_CAST({sql} AS BIGINT) AS VARCHAR)", "VARCHAR"
        if kind == "VARCHAR":
            return text_time(connection, table, sql, expression, time_format), "BIGINT"
        if time := as_timestamp(sql, kind):
            return f"TRY(epoch_ms({time}))", "BIGINT"
        remedy = "use milliseconds, a date or a timestamp, e.g. --column timestamp='seconds * 1000'"
    elif name in (schema.ACTION, schema.OBSERVATION):
        if is_vector(kind):
            return f"TRY_CAST({sql} AS FLOAT[])", "FLOAT[]"
        remedy = f"use a list of numbers, e.g. --column {name}='{expression}::FLOAT[]'"
    elif name == schema.PROPENSITY:
        if is_number(kind):
            # Numbers that are not above 0 stay, to be counted and refused.
            valid = f"{sql} BETWEEN -{MAX_FLOAT} AND {MAX_FLOAT}"
            return f"TRY(CAST(CASE WHEN {valid} THEN {sql} END AS FLOAT))", "FLOAT"
        remedy = "use a number above 0"
    else:
        if is_number(kind) or kind == "BOOLEAN":
            return f"coalesce(TRY(CAST({sql} AS DOUBLE)) = 1, false)", "BOOLEAN"
        remedy = "use a boolean or 0 and 1"
    # A part without any value has whatever type its writer gave it.
    if not connection.sql(f"SELECT 1 FROM {table.sql} WHERE {sql} IS NOT NULL LIMIT 1").fetchall():
        return nothing, NOTHING
    raise wrong_type(table, name, expression, kind, remedy)


def _unify_ids(
    connection: duckdb.DuckDBPyConnection, selects: list[_Select], name: str, as_text: bool
) -> None:
    """Cast ids to BIGINT if every file has integers that fit, else or with `as_text` to text.

    Text of a CSV file is an integer only if it is written as the integer is: 007, 7.0 and 1e1 are
    not. Ids that are written as 7 and as 7.0 are two ids, with a note.
    """
    whole, some_whole, with_decimals = True, False, None
    for select in selects:
        sql, kind = select.values[name]
        csv_type = _csv_type(select.table, sql)
        all_integers = is_integer(kind) and kind not in ("UBIGINT", "HUGEINT", "UHUGEINT")
        if csv_type is not None:
            with explained(connection, (select.table,), select.table.files[0].parent):
                ((any_integer, all_integers),) = connection.sql(
                    f"SELECT coalesce(bool_or({_IS_INTEGER}), false), "
                    f"coalesce(bool_and({_IS_INTEGER}), true) "
                    f"FROM (SELECT {sql} AS x FROM {select.table.sql}) WHERE x IS NOT NULL"
                ).fetchall()
            some_whole |= is_integer(csv_type) or (csv_type == "DOUBLE" and any_integer)
        some_whole |= is_integer(kind)
        if (csv_type or kind) == "DOUBLE":
            with_decimals = with_decimals or select.table
        whole &= kind == NOTHING or all_integers
    whole &= not as_text
    if not whole and some_whole and with_decimals is not None:
        warnings.warn(
            f"{name} is written as whole numbers and, in {with_decimals.files[0]}, with decimals: "
            f"7 and 7.0 are two ids; to make them one, say --column {name}='COLUMN::BIGINT'",
            InputNote,
            stacklevel=5,
        )
    for select in selects:
        sql, _ = select.values[name]
        # Text without a character is missing, as in a CSV file.
        typed = f"CAST({sql} AS BIGINT)" if whole else f"nullif(CAST({sql} AS VARCHAR), '')"
        select.values[name] = (typed, "")


def _csv_type(table: Table, sql: str) -> str | None:
    """The type that DuckDB inferred for a column whose text is read; None for other columns."""
    kinds = dict(table.types)
    return next((kinds[name] for name in table.raw if quoted(raw_name(name)) == sql), None)
