"""Bind columns and expressions to the columns of tables, and explain errors of files.

Of a later log, which of the columns are those that a run remembers of its training log.
"""

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import duckdb
from safetensors import SafetensorError

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.expressions import (
    NotScalarError,
    cast_truth_values,
    columns_of,
    refusal,
)
from ucfrec.logs.mapping import KEY_COLUMNS, LogMapping
from ucfrec.logs.tables import Table, fault_of_line, first_line, quoted

_NAME = re.compile(r"[^\W\d]\w*")
_DISK_FULL = ("No space left", "quota exceeded", "max_temp_directory_size", "requested and")
"""In messages of the system, of safetensors, of DuckDB's own disk limit, and of numpy."""


class Bound(NamedTuple):
    """What a column name or an expression is to a table."""

    sql: str
    kind: str
    """DuckDB type."""
    columns: tuple[str, ...]
    """Columns of the table that it reads."""
    is_column: bool
    """Whether it is the name of a column."""


def bind(connection: duckdb.DuckDBPyConnection, table: Table, what: str, expression: str) -> Bound:
    """Resolve a column name or scalar expression against the columns of `table`.

    An expression that computes with truth values, such as `is_click + 2 * is_like`, takes them as 0
    and 1.

    Args:
        expression: column name (case does not matter) or SQL expression.

    Raises:
        InputError: a name is not a column of the table, or `expression` is no scalar expression.
    """
    columns = table.columns
    names = {name.casefold(): name for name in columns}
    if expression.casefold() in names:
        name = names[expression.casefold()]
        return Bound(quoted(name), columns[name], (name,), True)
    if _NAME.fullmatch(expression):
        raise _missing(table, what, expression)
    try:
        # DuckDB would read some names that are not columns as the current user or time.
        reads = columns_of(connection, expression)
        for name in reads:
            if name.casefold() not in names:
                raise _missing(table, what, name)
        read_columns = tuple(dict.fromkeys(names[name.casefold()] for name in reads))
        try:
            sql = f"({expression}\n)"
            kind = _type_of(connection, sql, {name: columns[name] for name in read_columns})
        except duckdb.BinderException:
            truth = {name for name in read_columns if columns[name] == "BOOLEAN"}
            if not truth:
                raise
            sql = f"({cast_truth_values(connection, expression, truth)}\n)"
            kind = _type_of(connection, sql, {name: columns[name] for name in read_columns})
    except (duckdb.Error, NotScalarError) as error:
        raise refusal(what, expression, str(table.files[0]), first_line(error)) from None
    return Bound(sql, kind, read_columns, False)


def _type_of(connection: duckdb.DuckDBPyConnection, sql: str, columns: Mapping[str, str]) -> str:
    """DuckDB type of an expression over columns of some types."""
    nulls = ", ".join(f"CAST(NULL AS {kind}) AS {quoted(name)}" for name, kind in columns.items())
    source = f"FROM (SELECT {nulls})" if nulls else ""
    return str(connection.sql(f"DESCRIBE SELECT {sql} AS x {source}").fetchall()[0][1])


def _missing(table: Table, what: str, name: str) -> InputError:
    folded = {column.casefold(): column for column in table.columns}
    near = difflib.get_close_matches(name.casefold(), folded, n=3, cutoff=0.5)
    hint = ", ".join(folded[column] for column in near)
    hint = f"nearest: {hint}" if hint else f"it has {', '.join(table.columns)}"
    return InputError(f"{table.files[0]} has no column {name!r} ({what}); {hint}")


def wrong_type(table: Table, what: str, expression: str, kind: str, remedy: str) -> InputError:
    """Error for a column of an unsupported type."""
    return InputError(f"{table.files[0]}: {what} ({expression}) is {kind}; {remedy}")


@contextmanager
def explained(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], folder: Path
) -> Iterator[None]:
    """Turn errors of files, memory and disk that occur in the block into `InputError`.

    Args:
        folder: folder named when its disk is full.

    Raises:
        InputError: the memory limit or disk is exhausted, or a file or value cannot be read.
    """
    try:
        yield
    except (OSError, SafetensorError, duckdb.Error) as error:
        if any(phrase in str(error) for phrase in _DISK_FULL):
            raise InputError(
                f"no space left on the disk of {folder}; free space or write elsewhere"
            ) from None
        if not isinstance(error, duckdb.Error):
            raise
        if isinstance(error, duckdb.OutOfMemoryException):
            raise InputError(f"{first_line(error)}; raise memory_limit") from None
        raise _fault_of_files(connection, tables, error) or error from None


def _fault_of_files(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], error: duckdb.Error
) -> InputError | None:
    """The file, and its line or values, that an error is about; None for an error of DuckDB."""
    if fault := fault_of_line(error):
        return fault
    for table in tables:
        for file in table.files:
            try:
                single = replace(table, files=(file,))
                connection.sql(f"SELECT max(hash(t)) FROM {single.sql} AS t").fetchall()
            except duckdb.Error as damage:
                return fault_of_line(damage) or InputError(
                    f"{file} cannot be read, it may be damaged ({first_line(damage)}); fetch it "
                    "again"
                )
    if isinstance(error, duckdb.InternalError):
        return None
    files = ", ".join(str(file) for table in tables for file in table.files[:3])
    return InputError(
        f"{files}: {first_line(error)}; correct the values, or try_cast them in the mapping"
    )


def settled(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[Table],
    mapping: LogMapping,
    reward: str,
) -> tuple[LogMapping, str]:
    """The mapping and the reward of a log, whose columns have the names of a run's training log or
    the plain ones.

    What is given counts. Otherwise a remembered column, condition or reward counts if all files
    have the columns that it needs; if not, the plain name does, and no condition. The column
    `reward` stands for the reward of a log whose columns were mapped.

    Raises:
        InputError: a file has neither the remembered column nor the plain one that it must have.
    """
    remembered = mapping.remembered
    if remembered is None:
        return mapping, reward
    missing = _Missing(connection, tables)
    columns = dict(mapping.columns)
    for name, text in remembered.columns.items():
        if name in columns:
            continue
        if not text or missing.of(text) is None:
            columns[name] = text
        elif name in KEY_COLUMNS and (table := missing.of(name)) is not None:
            raise InputError(
                f"{table.files[0]} has neither {str(text)!r}, which is {name} in the log that the "
                f"run was trained on, nor a column {name!r}; map it with --column {name}=..."
            )
    usual = remembered.columns.get(schema.TIMESTAMP) or schema.TIMESTAMP
    if mapping.time_format is None and (columns.get(schema.TIMESTAMP) or schema.TIMESTAMP) == usual:
        mapping = replace(mapping, time_format=remembered.time_format)
    where = mapping.where
    if where is None and remembered.where and missing.of(remembered.where) is None:
        where = remembered.where
    mapped = any(remembered.columns.values())
    if mapped and missing.of(reward) is not None and missing.of(schema.REWARD) is None:
        reward = schema.REWARD
    return replace(mapping, columns=columns, where=where, remembered=None), reward


class _Missing:
    """Finds tables that lack a column that an expression needs."""

    def __init__(self, connection: duckdb.DuckDBPyConnection, tables: Sequence[Table]) -> None:
        self._connection, self._tables = connection, tables

    def of(self, expression: str) -> Table | None:
        """The first of them; None if all tables have what the column or expression reads."""
        for table in self._tables:
            names = {name.casefold() for name in table.columns}
            if expression.casefold() in names:
                continue
            if expression.isidentifier():
                return table
            try:
                reads = columns_of(self._connection, expression)
            except (duckdb.Error, NotScalarError):
                continue  # it is refused where it is bound, with the reason
            if not {name.casefold() for name in reads} <= names:
                return table
        return None
