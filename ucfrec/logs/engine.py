"""DuckDB connections that can open nothing but their inputs, and expressions over their tables.

Every text that is run as SQL is bound here to the columns of a table first, and what DuckDB says of
files, memory and disk is explained here. Of a later log, `settle_mapping` chooses between the
columns that a run remembers of its training log and the plain ones.
"""

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import duckdb
import numpy as np
from safetensors import SafetensorError

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.errors import InputError
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.expressions import NotScalarError, cast_truth_values, columns_of, refusal
from ucfrec.logs.mapping import KEY_COLUMNS, LogMapping
from ucfrec.logs.tables import (
    EXPOSED,
    Table,
    fault_of_line,
    first_line,
    glob_pattern,
    quote,
    quote_name,
)
from ucfrec.settings import nearest

if TYPE_CHECKING:
    import pyarrow as pa

BATCH_ROWS = 2**17
"""Most rows of a batch read from DuckDB."""
_BESIDE = 370 * 2**20
"""Bytes that going through rows takes beside the engine and what the process has already."""
_CLOSED = {
    "allow_community_extensions": False,
    "allow_persistent_secrets": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    # Otherwise SQL could read any Python variable as a table.
    "python_enable_replacements": False,
}
_OF_JOIN = (
    *(schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP),
    *(schema.REQUEST_ID, schema.POSITION, schema.PROPENSITY),
    *(schema.SESSION_BEGAN, schema.EXCLUDES_SEEN, schema.CANDIDATES),
)
"""Log columns that logs of `join` have."""
_OF_ENGINE = re.compile(r"[A-Z][A-Za-z ]+ Error: ")
_DISK_FULL = ("No space left", "quota exceeded", "File too large", "max_temp_dir", "requested and")
"""In messages of the system, of safetensors, of DuckDB's own disk limit, and of numpy."""


@contextmanager
def engine(
    inputs: Iterable[Path],
    folder: Path | None,
    memory_limit: str | None = None,
    threads: int | None = None,
) -> Iterator[duckdb.DuckDBPyConnection]:
    """A DuckDB connection that can open only the inputs and files in its scratch folder.

    It loads no extension, and its configuration is locked. Every DuckDB connection of ucfrec is
    made here. `folder` is the parent of the scratch folder, which is removed at the end; so is the
    scratch of killed processes in it. None for a database in memory that never uses the disk.
    Beyond `memory_limit` of the process, such as "2GB", of which all but the engine may take half,
    rows spill to disk. Raises InputError if it is not a size.
    """
    with scratch_folder(folder.absolute(), "rows") if folder else nullcontext() as work:
        spill = str(work / "spill") if work else ""
        # In the name of a database, DuckDB reads "?" and "\\" as those of an address.
        database = f"{work}/rows.duckdb" if work and not {*"?\\"} & {*str(work)} else ":memory:"
        connection = duckdb.connect(database, config={**_CLOSED, "temp_directory": spill})
        try:
            if memory_limit is not None:
                if not (limit := bytes_of(memory_limit)):
                    raise InputError(f"memory_limit {memory_limit!r} is not a size; write e.g. 2GB")
                limit = max(limit - anonymous_bytes() - _BESIDE, limit // 2)
                connection.execute(f"SET memory_limit = '{limit} B'")
            if threads is not None:
                connection.execute("SET threads = ?", [threads])
            _set_semantics(connection)
            # Other files are forbidden and the settings locked, after every other setting. DuckDB
            # first looks a path up as a glob pattern, then opens the file that it matches.
            allowed = {path for file in inputs for path in (str(file), glob_pattern(file))}
            if work:
                paths = ", ".join(map(quote, sorted(allowed)))
                connection.execute(f"SET allowed_directories = [{quote(str(work))}]")
                connection.execute(f"SET allowed_paths = [{paths}]")
            connection.execute("SET enable_external_access = false")
            connection.execute("SET lock_configuration = true")
            yield connection
        finally:
            connection.close()


def _set_semantics(connection: duckdb.DuckDBPyConnection) -> None:
    """Make expressions mean the same in every connection and on every machine."""
    # In Jupyter without ipywidgets it is off already, and cannot be set.
    if connection.sql("SELECT current_setting('enable_progress_bar')").fetchall() != [(False,)]:
        connection.execute("SET enable_progress_bar = false")
    # A division by zero is NULL, and so is every comparison with it; infinity would be above every
    # threshold. The logarithm of a negative number is an error, for TRY, instead of NaN.
    connection.execute("SET error_on_division_by_zero = false")
    connection.execute("SET ieee_floating_point_ops = false")
    # What an expression computes twice DuckDB would compute once, but outside of its TRY.
    connection.execute("SET disabled_optimizers = 'common_subexpressions'")
    # Casts from TIMESTAMPTZ to TIMESTAMP use this zone.
    connection.execute("SET TimeZone = 'UTC'")
    # DuckDB's least(x, 5) is 5 if x is NULL, NaN or infinite: a video of unknown length would
    # count as watched five times. Here an undefined argument makes the result NULL.
    for name, sign in (("least", "<"), ("greatest", ">")):
        connection.execute(
            f"CREATE TEMP MACRO {name}(a, b) AS CASE WHEN isfinite(a::DOUBLE) AND "
            f"isfinite(b::DOUBLE) THEN CASE WHEN a {sign} b THEN a ELSE b END END, "
            f"(a, b, c) AS {name}({name}(a, b), c)"
        )
    # Tables read NaN as missing (`ucfrec.logs.tables.Table`).
    connection.execute("CREATE TEMP MACRO isnan(a) AS coalesce(system.main.isnan(a), true)")


def anonymous_bytes(process: int | None = None) -> int:
    """Memory of a process (by number; None for this one) that is not mapped from files; 0 where
    the system does not say, or the process has ended."""
    try:
        lines = Path(f"/proc/{process or os.getpid()}/status").read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon:"))


def bytes_of(size: str) -> int | None:
    """A size such as "2GB" or "1.5 GiB" in bytes; None if it is written in another way."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([kmgt]?)(i?)b?\s*", size.lower())
    if match is None:
        return None
    return int(float(match[1]) * (1024 if match[3] else 1000) ** " kmgt".index(match[2] or " "))


def to_numpy(column: "pa.Array") -> Array:
    """A column of numbers or truth values without missing ones, or the values in its lists, copied
    only if it must be; `pyarrow.Array.to_numpy` would import pandas, which takes long."""
    if str(column.type).startswith("list"):
        return to_numpy(column.flatten())
    if str(column.type) == "bool":
        return np.from_dlpack(column.cast("uint8")).view(np.bool_)
    return np.from_dlpack(column)


def to_arrow(numbers: IntArray | BoolArray) -> "pa.Array":
    """Whole numbers, or truth values as 0 and 1; `pyarrow.array` would import pandas."""
    import pyarrow as pa

    buffer = pa.py_buffer(np.ascontiguousarray(numbers, dtype=np.int64))
    return pa.Array.from_buffers(pa.int64(), len(numbers), [None, buffer])


class Bound(NamedTuple):
    """What a column name or an expression is to a table."""

    sql: str
    kind: str
    """DuckDB type."""
    columns: tuple[str, ...]
    """Columns of the table that it reads."""
    is_column: bool
    """Whether it is the name of a column."""


def bind(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    what: str,
    expression: str,
) -> Bound:
    """Resolve a column name (in any case) or a scalar SQL expression against a table's columns.

    An expression that computes with truth values, such as `is_click + 2 * is_like`, takes them as 0
    and 1. Raises InputError if a name is not a column of the table, or `expression` no scalar one.
    """
    columns = table.columns
    names = {name.casefold(): name for name in columns}
    if expression.casefold() in names:
        name = names[expression.casefold()]
        return Bound(quote_name(name), columns[name], (name,), True)
    if expression.isidentifier():
        raise _missing(table, what, expression)
    try:
        # DuckDB would read some names that are not columns as the current user or time.
        types = {}
        for written in columns_of(connection, expression):
            if written.casefold() not in names:
                raise _missing(table, what, written)
            name = names[written.casefold()]
            types[name] = columns[name]
        sql = f"({expression}\n)"
        try:
            kind = _find_type(connection, sql, types)
        except duckdb.BinderException:
            find_type = partial(_find_type, connection, columns=types)
            sql = f"({cast_truth_values(connection, expression, find_type)})"
            kind = find_type(sql)
    except (duckdb.Error, NotScalarError) as error:
        raise refusal(what, expression, str(table.files[0]), first_line(error)) from None
    return Bound(sql, kind, tuple(types), False)


def _find_type(connection: duckdb.DuckDBPyConnection, sql: str, columns: Mapping[str, str]) -> str:
    """DuckDB type of an expression over columns of some types."""
    nulls = (f"CAST(NULL AS {kind}) AS {quote_name(name)}" for name, kind in columns.items())
    source = f"FROM (SELECT {', '.join(nulls)})" if columns else ""
    return str(connection.sql(f"DESCRIBE SELECT {sql} AS x {source}").fetchall()[0][1])


def _missing(table: Table, what: str, name: str) -> InputError:
    hint = nearest(name, list(table.columns))
    if f"{name}=" in str(table.files[0].parent):
        hint = "folders name its values: add --partitions"
    return InputError(f"{table.files[0]} has no column {name!r} ({what}); {hint}")


def wrong_type(
    table: Table,
    what: str,
    expression: str,
    kind: str,
    remedy: str,
) -> InputError:
    """Error for a column of an unsupported type."""
    if kind.startswith("STRUCT") and kind.endswith(")"):
        remedy = f"name one of its fields, as in {expression}.FIELD"
    return InputError(f"{table.files[0]}: {what} ({expression}) is {kind}; {remedy}")


@contextmanager
def explain_errors(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], folder: Path | None = None
) -> Iterator[None]:
    """Turn errors of files, memory and disks in the block into `InputError`: the limit or a disk is
    exhausted, or a file or value cannot be read. A full disk is that of the engine or `folder`."""
    try:
        yield
    except (OSError, SafetensorError, duckdb.Error) as error:
        # Of rows that are read through Arrow, the engine's errors are OSError.
        of_engine = isinstance(error, duckdb.Error) or _OF_ENGINE.match(str(error))
        if any(phrase in str(error) for phrase in _DISK_FULL):
            if of_engine or folder is None:
                with suppress(duckdb.Error):
                    # A cursor, as the result that failed may still be open.
                    setting = connection.cursor().sql("SELECT current_setting('temp_directory')")
                    folder = Path(setting.fetchall()[0][0]).parent.parent
            raise InputError(
                f"no space left on the disk of {folder}; free space or write elsewhere"
            ) from None
        if str(error).startswith("Out of Memory"):
            raise InputError(f"{first_line(error)}; raise memory_limit") from None
        if not isinstance(error, duckdb.Error):
            raise
        raise _find_fault(connection, tables, error) or error from None


def _find_fault(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], error: duckdb.Error
) -> InputError | None:
    """The file, and its line or values, that an error is about; None for an error of DuckDB."""
    if fault := fault_of_line(error):
        return fault
    for file, single in ((f, replace(t, files=(f,))) for t in tables for f in t.files):
        try:
            connection.sql(f"SELECT max(hash(t)) FROM {single.sql} AS t").fetchall()
        except duckdb.Error as damage:
            return fault_of_line(damage) or InputError(
                f"{file} cannot be read, it may be damaged ({first_line(damage)}); fetch it again"
            )
    if isinstance(error, duckdb.InternalError):
        return None
    files = ", ".join(str(file) for table in tables for file in table.files[:3])
    return InputError(
        f"{files}: {first_line(error)}; correct the values, or try_cast them in the mapping"
    )


def settle_mapping(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[Table],
    mapping: LogMapping,
    reward: str,
) -> tuple[LogMapping, str]:
    """The mapping and the reward of a log, with the names of a run's training log or plain ones.

    What is mapped counts. Otherwise a remembered column, condition or reward counts if all files
    have the columns that it needs; if not, the plain name does, and no condition. The column
    `reward` stands for the reward of a log whose columns were mapped. What a log of `join` lacks is
    not mapped. InputError if a file has neither the remembered column nor the plain one.
    """
    joined = [table for table in tables if table.of_exposures]
    feedback = [table for table in tables if not table.of_exposures]
    columns = {
        name: text
        for name, text in mapping.columns.items()
        if name in _OF_JOIN or not text or _find_lacking(connection, joined, text) is None
    }
    remembered = mapping.remembered
    if remembered is None:
        return replace(mapping, columns=columns), reward
    for name, text in remembered.columns.items():
        having = feedback if name in _OF_JOIN else tables
        if name in mapping.columns or not having:
            continue
        if not text or _find_lacking(connection, having, text) is None:
            columns[name] = text
        elif name in KEY_COLUMNS and (table := _find_lacking(connection, having, name)):
            raise InputError(
                f"{table.files[0]} has neither {str(text)!r}, which is {name} in the log that the "
                f"run was trained on, nor a column {name!r}; map it with --column {name}=..."
            )
    usual = remembered.columns.get(schema.TIMESTAMP) or schema.TIMESTAMP
    if mapping.time_format is None and (columns.get(schema.TIMESTAMP) or schema.TIMESTAMP) == usual:
        mapping = replace(mapping, time_format=remembered.time_format)
    where, earlier = mapping.where, remembered.where
    if where is None and earlier and _find_lacking(connection, tables, earlier) is None:
        where = earlier
    if (
        any(remembered.columns.values())
        and _find_lacking(connection, tables, reward) is not None
        and _find_lacking(connection, tables, schema.REWARD) is None
    ):
        reward = schema.REWARD
    return replace(mapping, columns=columns, where=where, remembered=None), reward


def _find_lacking(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], expression: str
) -> Table | None:
    """The first table that lacks a column which a name or expression reads; None if none does."""
    for table in tables:
        names = {name.casefold() for name in table.columns}
        if expression.casefold() not in names and not _read_names(connection, expression) <= names:
            return table
    return None


def _read_names(connection: duckdb.DuckDBPyConnection, expression: str) -> set[str]:
    """Columns that a name or expression reads, in lower case; none of one that cannot be bound."""
    if expression.isidentifier():
        return {expression.casefold()}
    try:
        return {name.casefold() for name in columns_of(connection, expression)}
    except (duckdb.Error, NotScalarError):
        return set()  # it is refused where it is bound, with the reason


def text_of_column(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    mapping: LogMapping,
    name: str,
) -> str:
    """The column or expression that a log column is in a table. Those of a log of `join` have the
    names of `join`, unless what is mapped reads these, such as `timestamp + position`."""
    text = mapping.columns.get(name) or name
    if table.of_exposures and name in _OF_JOIN:
        reads = _read_names(connection, text)
        return text if reads and reads <= {*_OF_JOIN, *EXPOSED} else name
    return text
