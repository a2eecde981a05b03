"""A log as one relation of typed rows: its columns, its vectors, its times, its reward."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import duckdb

from ucfrec import schema
from ucfrec.errors import InputError, warn_user
from ucfrec.logs.engine import (
    BATCH_ROWS,
    Bound,
    bind,
    explain_errors,
    settle_mapping,
    text_of_column,
    wrong_type,
)
from ucfrec.logs.mapping import OPTIONAL_COLUMNS, LogMapping
from ucfrec.logs.tables import (
    ISO_TIME,
    MAX_FLOAT,
    NOTHING,
    WHOLE,
    Table,
    cast_integer,
    cast_timestamp,
    first_and_more,
    is_integer,
    is_number,
    is_vector,
    open_tables,
    quote,
    quote_name,
    raw_name,
)

ROWS = "read"
"""Relation of `TypedLog`."""
WANTED = "wanted"
"""Its column of whether a row fulfils the condition of `LogMapping.where`, if there is one."""
VECTORS = (schema.ACTION, schema.OBSERVATION)
_BATCH_BYTES = 2**25
_IDS = (schema.USER_ID, schema.ITEM_ID, schema.SESSION_ID, schema.REQUEST_ID)
AVAILABLE = ("available_from", "available_until")
_TIMES = (schema.TIMESTAMP, schema.SESSION_BEGAN, *AVAILABLE)
_TYPES = {
    **dict.fromkeys(_IDS, "VARCHAR"),
    schema.ACTION: "FLOAT[]",
    schema.OBSERVATION: "FLOAT[]",
    schema.PROPENSITY: "FLOAT",
    schema.IS_RANDOM: "BOOLEAN",
    schema.POSITION: "DOUBLE",
    schema.EXCLUDES_SEEN: "BOOLEAN",
    schema.CANDIDATES: "VARCHAR",
    **dict.fromkeys(_TIMES, "BIGINT"),
}
KEY_OF_LIST = "CASE WHEN len({0}) > 0 THEN CAST(hash({0}) AS VARCHAR) END"
"""SQL of the name of a set of candidates that is a list in the log."""


@dataclass(frozen=True)
class LogTables:
    """The tables of a log, and what their columns mean."""

    connection: duckdb.DuckDBPyConnection
    tables: tuple[Table, ...]
    mapping: LogMapping
    reward: str
    """Scalar SQL expression over the files' columns."""
    session_by: str | None
    """"session_id", "gap" or "user"; None for session_id if the log has it, else gap."""


def open_log_tables(
    connection: duckdb.DuckDBPyConnection,
    files: Sequence[Path],
    mapping: LogMapping,
    reward: str,
    session_by: str | None,
) -> LogTables:
    """Open the files of a log, and settle which of the remembered columns they have."""
    tables = tuple(open_tables(connection, files, mapping.partitions))
    mapping, reward = settle_mapping(connection, tables, mapping, reward)
    return LogTables(connection, tables, mapping, reward, session_by)


@dataclass(frozen=True)
class TypedLog:
    """A log with SQL of its typed columns; `open_log` creates the relation `read` of its rows.

    `read` has the log columns of `columns` in the types of the schema, `reward` (DOUBLE) and `row`
    (position in the files, from 1); no row has been checked.
    """

    connection: duckdb.DuckDBPyConnection
    tables: tuple[Table, ...]
    """The tables with no other columns than the values need."""
    selects: tuple[str, ...]
    """For each table, the values of `columns`, `reward` and perhaps `WANTED`, as after SELECT."""
    columns: tuple[str, ...]
    """Log columns that the files have, `user_id` first."""
    session_by: str
    """"session_id", "gap" or "user"."""
    mapping: LogMapping
    vector_size: Mapping[str, int] = field(default_factory=dict)
    """Dimensions of `action` and `observation`, if the log has them; see `measure_vectors`."""

    @property
    def key(self) -> str:
        """Column of the choice: `item_id` or `action`."""
        return schema.ITEM_ID if schema.ITEM_ID in self.columns else schema.ACTION

    @property
    def required(self) -> tuple[str, ...]:
        """Columns that no row may lack."""
        keys = schema.USER_ID, self.key, schema.TIMESTAMP
        return (*keys, schema.SESSION_ID) if self.session_by == schema.SESSION_ID else keys

    @property
    def batch_rows(self) -> int:
        """Rows of a batch of its rows, fewer if they are long."""
        row_bytes = 64 + 4 * sum(self.vector_size.values())
        return min(BATCH_ROWS, max(_BATCH_BYTES // row_bytes, 1))

    @property
    def name(self) -> str:
        """The first file, and how many more there are, for messages."""
        return first_and_more([file for table in self.tables for file in table.files])

    def find_type(self, name: str) -> str:
        """DuckDB type of a column, of ids BIGINT or VARCHAR."""
        return str(self.one(f"DESCRIBE SELECT {name} FROM {ROWS}")[1])

    def one(self, sql: str) -> tuple[Any, ...]:
        """The first row of the result of `sql`."""
        row: tuple[Any, ...] = self.connection.sql(sql).fetchall()[0]
        return row

    def require_items(self) -> None:
        """Raise InputError if its actions are vectors."""
        if self.key != schema.ITEM_ID:
            raise InputError(f"{self.name}: its actions are vectors; map item_id instead")


def type_columns(log: LogTables, as_text: Collection[str] = ()) -> TypedLog:
    """Resolve the columns and the reward of a log; `as_text` are ids that are text even if all of
    them are integers.

    Optional columns that only some of the files have are excluded, with an `InputNote`. Raises
    InputError if a column is missing or of an unsupported type, or an expression cannot be used.
    """
    # `bind` reports required columns that are missing.
    mapped = {name for name, value in log.mapping.columns.items() if value}
    names = [{column.casefold() for column in table.columns} for table in log.tables]
    present = mapped | (names[0].intersection(*names) - log.mapping.columns.keys())
    if log.session_by == schema.SESSION_ID:
        present.add(log.session_by)
    vectors_only = schema.ACTION in present and schema.ITEM_ID not in present
    key = schema.ACTION if schema.ACTION in mapped or vectors_only else schema.ITEM_ID
    optional = (name for name in OPTIONAL_COLUMNS if name in present)
    columns = (schema.USER_ID, key, schema.TIMESTAMP, *optional)
    every = [file for table in log.tables for file in table.files]
    for name in (n for n in OPTIONAL_COLUMNS if n not in {*columns, *log.mapping.columns}):
        having = (table for table, folded in zip(log.tables, names, strict=True) if name in folded)
        if files := [file for table in having for file in table.files]:
            warn_user(
                f"{name} is excluded: only {len(files)} of {len(every)} files have it ({files[0]});"
                f" add it to the others, or drop it with --column {name}="
            )
    selects = [_select(log, table, columns) for table in log.tables]
    for name in _IDS:
        if name in columns:
            _unify_ids(log.connection, selects, name, name in as_text)
    return TypedLog(
        log.connection,
        tuple(table for table, _ in selects),
        tuple(", ".join(f"{s} AS {n}" for n, (s, _) in values.items()) for _, values in selects),
        columns,
        log.session_by or (schema.SESSION_ID if schema.SESSION_ID in columns else "gap"),
        log.mapping,
    )


def number_rows(selects: Iterable[tuple[str, Table]]) -> str:
    """SQL of typed rows with `row`, their position from 1, of values as of `TypedLog.selects`."""
    union = " UNION ALL ".join(f"SELECT {values} FROM {table.sql}" for values, table in selects)
    return f"SELECT row_number() OVER () AS row, * FROM ({union})"


def open_log(log: LogTables, as_text: Collection[str] = ()) -> TypedLog:
    """Create `read` from the tables of a log; see `type_columns` and `measure_vectors`."""
    typed = type_columns(log, as_text)
    with explain_errors(log.connection, log.tables):
        # Columns of Parquet files are read as often as they are needed; text is parsed once.
        kind = "VIEW" if all(table.columnar for table in log.tables) else "TABLE"
        rows = number_rows(zip(typed.selects, typed.tables, strict=True))
        log.connection.execute(f"CREATE {kind} {ROWS} AS {rows}")
        query = survey_vectors(typed.columns, ROWS)
        has_vectors = {*VECTORS} & {*typed.columns}
        return measure_vectors(typed, log.connection.sql(query).fetchall() if has_vectors else [])


def survey_vectors(columns: Collection[str], rows: str) -> str:
    """SQL of the least and the largest size of `action` and of `observation` in rows of a log with
    some columns, the number `n` of rows, and how many of them have no finite observation."""
    sizes = (
        f"CAST({end}({f'len({name})' if name in columns else 'NULL'}) AS BIGINT) AS {end}_{name}"
        for name in VECTORS
        for end in ("min", "max")
    )
    bad = f"count_if({not_finite(schema.OBSERVATION)})" if schema.OBSERVATION in columns else "0"
    return f"SELECT {', '.join(sizes)}, count(*) AS n, CAST({bad} AS BIGINT) AS bad FROM {rows}"


def measure_vectors(log: TypedLog, survey: Sequence[tuple[int, ...]]) -> TypedLog:
    """The log with the sizes of its vectors, by the rows of `survey_vectors`.

    Raises InputError if sizes are unequal or 0, or an observation is not finite.
    """
    sizes: dict[str, int] = {}
    for place, name in enumerate(VECTORS):
        if name in log.columns:
            ends = [n for row in survey for n in row[2 * place : 2 * place + 2] if n is not None]
            least, sizes[name] = min(ends, default=0), max(ends, default=0)
            if not 0 < least == sizes[name]:
                raise InputError(
                    f"{name} has lists of {least} to {sizes[name]} numbers; make them equally "
                    f"long, map another column or --column {name}="
                )
    if bad := sum(row[-1] for row in survey):
        raise InputError(
            f"{log.tables[0].files[0]}: {schema.OBSERVATION} is missing or holds NaN or infinity "
            f"in {bad:,} of {sum(row[-2] for row in survey):,} rows; fill them in, leave those "
            f"rows out, or ignore the column with --column {schema.OBSERVATION}="
        )
    return replace(log, vector_size=sizes)


def not_finite(vector: str) -> str:
    """SQL that says whether a vector is missing or has a number that is not finite."""
    finite = f"list_bool_and([coalesce(isfinite(v), false) FOR v IN {vector}])"
    return f"{vector} IS NULL OR NOT {finite}"


_REWARD = "for the reward; name it with --reward, or give --reward 1 if users chose every row"
_Values = dict[str, tuple[str, str]]


def _select(log: LogTables, table: Table, columns: tuple[str, ...]) -> tuple[Table, _Values]:
    """A table with the columns that are read, and the (SQL, DuckDB type) of each log column."""
    connection, mapping = log.connection, log.mapping
    texts = {name: text_of_column(connection, table, mapping, name) for name in columns}
    time_format = None if table.of_exposures else mapping.time_format
    bound = {
        name: bind(connection, table, f"for {name}; map it with --column {name}=...", expression)
        for name, expression in texts.items()
    }
    # The text of a CSV file is what its identifiers and times are, not what DuckDB makes of it.
    raw = {
        name: value.columns[0]
        for name, value in bound.items()
        if not table.columnar and value.is_column and value.columns[0] in dict(table.types)
        if name in (*_IDS, schema.CANDIDATES) or (name == schema.TIMESTAMP and time_format)
    }
    for name, column in raw.items():
        bound[name] = Bound(quote_name(raw_name(column)), "VARCHAR", (), False)
    table, reward = _bind_reward(connection, table, log.reward)
    if not (is_number(reward.kind) or reward.kind in ("BOOLEAN", NOTHING)):
        remedy = "use a number or truth value, such as try_cast(COLUMN AS DOUBLE) or COLUMN = 'yes'"
        raise wrong_type(table, "reward", log.reward, reward.kind, remedy)
    # An error in one row (division by zero, a cast) makes only that row's reward undefined.
    extra = {schema.REWARD: (f"TRY(CAST({reward.sql} AS DOUBLE))", "DOUBLE")}
    sources = [*bound.values(), reward]
    if mapping.where is not None:
        condition = bind(connection, table, "for --where", mapping.where)
        if condition.kind != "BOOLEAN":
            remedy = "write a condition, e.g. user_id <> 'bot'"
            raise wrong_type(table, "--where", mapping.where, condition.kind, remedy)
        extra[WANTED] = (f"TRY({condition.sql})", "BOOLEAN")
        sources.append(condition)
    narrow = table.of((column for value in sources for column in value.columns), raw.values())
    values = {
        name: cast_value(connection, narrow, name, texts[name], value, time_format)
        for name, value in bound.items()
    }
    return narrow, {**values, **extra}


def _bind_reward(
    connection: duckdb.DuckDBPyConnection, table: Table, reward: str
) -> tuple[Table, Bound]:
    """The reward, and the table in which a column of text without a value has no type."""
    try:
        return table, bind(connection, table, _REWARD, reward)
    except InputError:
        kinds, words = dict(table.types), reward.casefold()
        for name in (n for n, kind in table.types if kind == "VARCHAR" and n.casefold() in words):
            query = f"SELECT 1 FROM {table.sql} WHERE {quote_name(name)} IS NOT NULL LIMIT 1"
            if not connection.sql(query).fetchall():
                kinds[name] = NOTHING
        table = replace(table, types=tuple(kinds.items()))
        return table, bind(connection, table, _REWARD, reward)


def cast_value(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    name: str,
    expression: str,
    bound: Bound,
    time_format: str | None,
) -> tuple[str, str]:
    """SQL that casts a column to its type in the schema, and that DuckDB type."""
    sql, kind = bound.sql, bound.kind
    nothing = "false" if _TYPES[name] == "BOOLEAN" else f"CAST(NULL AS {_TYPES[name]})"
    if kind.removesuffix("[]") == NOTHING:
        return nothing, NOTHING
    # Of times as DOUBLE, a rounded nanosecond is none of the milliseconds.
    inexact = {**dict.fromkeys(_TIMES, ("FLOAT",)), **dict.fromkeys(_IDS, WHOLE)}.get(name, ())
    for column in (column for column in bound.columns if table.columns[column] in inexact):
        real = table.columns[column]
        with explain_errors(connection, (table,)):
            ((rounded, count),) = connection.sql(
                f"SELECT count_if(abs(x) >= {WHOLE[real]}), count(x) FROM "
                f"(SELECT {quote_name(column)} AS x FROM {table.of([column]).sql})"
            ).fetchall()
        if rounded:
            raise InputError(
                f"{table.files[0]}: {name} ({expression}) reads {column}, which is {real}, and "
                f"{rounded:,} of {count:,} values are {WHOLE[real]:,} or more and rounded; write "
                "them as int64 where the log is made, as a cast here cannot restore them"
            )
    if name in _IDS:
        if is_integer(kind) or kind in ("VARCHAR", "UUID"):
            return sql, kind
        cast = "BIGINT" if is_number(kind) else "VARCHAR"
        remedy = f"use integers or text, e.g. --column {name}='({expression})::{cast}'"
        if is_number(kind):
            remedy += ", if all are whole numbers of at most 15 digits: others would be rounded"
        elif kind.endswith("]"):
            remedy = "use integers or text, and a row for every entry of a list"
    elif name in _TIMES:
        if is_number(kind) and time_format is None:
            return f"TRY_CAST(round({sql}) AS BIGINT)", "BIGINT"
        if is_number(kind):
            sql, kind = f"CAST(TRY_CAST({sql} AS BIGINT) AS VARCHAR)", "VARCHAR"
        if kind == "VARCHAR":
            what = f"{name} ({expression})"
            return cast_text_time(connection, table, sql, what, time_format), "BIGINT"
        if time := cast_timestamp(sql, kind):
            return f"TRY(epoch_ms({time}))", "BIGINT"
        remedy = "use milliseconds, a date or a timestamp"
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
    elif name == schema.POSITION:
        if is_number(kind):
            return f"CAST({sql} AS DOUBLE)", "DOUBLE"
        remedy = "use a number"
    elif name == schema.CANDIDATES:
        if (ids := kind.removesuffix("[]")) in ("VARCHAR", "UUID") or is_integer(ids):
            key = KEY_OF_LIST if kind != ids else "nullif(CAST({} AS VARCHAR), '')"
            return key.format(sql), "VARCHAR"
        remedy = "use a list of item_ids, or integers or text that name a set of candidates"
    else:
        if is_number(kind) or kind == "BOOLEAN":
            return f"coalesce(TRY(CAST({sql} AS DOUBLE)) = 1, false)", "BOOLEAN"
        remedy = "use a boolean or 0 and 1"
    # A part without any value has whatever type its writer gave it.
    if not connection.sql(f"SELECT 1 FROM {table.sql} WHERE {sql} IS NOT NULL LIMIT 1").fetchall():
        return nothing, NOTHING
    raise wrong_type(table, name, expression, kind, remedy)


def _unify_ids(
    connection: duckdb.DuckDBPyConnection,
    selects: list[tuple[Table, _Values]],
    name: str,
    as_text: bool,
) -> None:
    """Cast ids to BIGINT if every file has integers of 64 bits that, in a CSV file, are written as
    integers are (not 007, 7.0 or 1e1), else or with `as_text` to text."""
    whole, some_whole, with_decimals = not as_text, False, None
    for table, values in selects:
        sql, kind = values[name]
        # The type that DuckDB inferred for a column of a CSV file, whose text is read.
        csv_type = next((t for name, t in table.types if quote_name(raw_name(name)) == sql), None)
        all_integers = is_integer(kind)
        if csv_type is not None or kind in ("UBIGINT", "HUGEINT", "UHUGEINT"):
            with explain_errors(connection, (table,)):
                ((any_integer, all_integers),) = connection.sql(
                    "SELECT count(x) > 0, count(x) = count(*) FROM (SELECT "
                    f"{cast_integer(sql)} AS x FROM {table.sql} WHERE {sql} IS NOT NULL)"
                ).fetchall()
            some_whole |= csv_type == "DOUBLE" and any_integer
        some_whole |= is_integer(csv_type or kind)
        if (csv_type or kind) == "DOUBLE":
            with_decimals = with_decimals or table
        whole &= kind == NOTHING or all_integers
    if not whole and some_whole and with_decimals is not None:
        warn_user(
            f"{name} is written as whole numbers and, in {with_decimals.files[0]}, with decimals: "
            f"7 and 7.0 are two ids; to make them one, say --column {name}='COLUMN::BIGINT'"
        )
    for _, values in selects:
        sql, _ = values[name]
        # Text without a character is missing, as in a CSV file.
        typed = f"CAST({sql} AS BIGINT)" if whole else f"nullif(CAST({sql} AS VARCHAR), '')"
        values[name] = (typed, "")


def cast_text_time(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    sql: str,
    what: str,
    time_format: str | None,
) -> str:
    """SQL of the milliseconds since 1970 (UTC) that a column of text means, NULL where it is none.

    `time_format` is that of `strptime`, in which all times are written; None for numbers and ISO
    8601. Times without a zone are UTC. Raises InputError if none of the text of a file is a time.
    """
    if time_format is not None:
        time = f"try_strptime(trim({sql}), {quote(time_format)})"
        return f"epoch_ms(TRY(CAST({time} AS TIMESTAMPTZ)))"
    is_time = f"TRY_CAST(x AS DOUBLE) IS NOT NULL OR regexp_full_match(x, {quote(ISO_TIME)})"
    for file in table.files:
        texts = f"SELECT nullif(trim(CAST({sql} AS VARCHAR)), '') AS x"
        counts = f"SELECT count_if({is_time}), min(x) FILTER (NOT ({is_time}))"
        with explain_errors(connection, (table,)):
            query = f"{counts} FROM ({texts} FROM {replace(table, files=(file,)).sql})"
            ((n_times, strange),) = connection.sql(query).fetchall()
        if n_times or strange is None:
            continue
        remedy = "say how it is written with --time-format, e.g. '%d/%m/%Y %H:%M'"
        if what.startswith(AVAILABLE):
            remedy = "write one of these, or nothing for no bound"
        raise InputError(
            f"{file}: {what} is {strange!r:.60}, no ISO 8601 time nor milliseconds; {remedy}"
        )
    plain = f"replace(replace(replace(trim({sql}), '/', '-'), ',', '.'), 'UTC', 'Z')"
    # DuckDB reads no zone after a blank.
    plain = f"regexp_replace({plain}, '\\s+(Z|[+-]\\d{{2}}(:?\\d{{2}})?)$', '\\1')"
    time = f"TRY(epoch_ms(TRY_CAST({plain} AS TIMESTAMPTZ)::TIMESTAMP))"
    return f"coalesce(TRY_CAST(round(TRY_CAST({sql} AS DOUBLE)) AS BIGINT), {time})"
