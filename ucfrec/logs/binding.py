"""Bind columns and expressions to the columns of tables, and explain errors of files.

Of a later log, which of the columns are those that a run remembers of its training log.
"""

import difflib
import errno
import re
from collections.abc import Iterator, Sequence
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
    columns_of,
    refused,
    with_numbers_for_truth_values,
)
from ucfrec.logs.mapping import KEY_COLUMNS, LogMapping
from ucfrec.logs.tables import Table, fault_of_line, first_line, quoted

_NAME = re.compile(r"[^\W\d]\w*")


class Bound(NamedTuple):
    """What a column name or an expression is to a table."""

    sql: str
    kind: str
    """DuckDB type."""
    columns: tuple[str, ...]
    """Columns of the table that it reads."""
    is_column: bool
    """Whether it is the name of a column."""


def bind(connection: duckdb.DuckDBPyConnection, table: Table, what: str, given: str) -> Bound:
    """Resolve a column name or scalar expression against the columns of `table`.

    An expression that computes with truth values, such as `is_click + 2 * is_like`, takes them as 0
    and 1.

    Args:
        given: column name (case does not matter) or SQL expression.

    Raises:
        InputError: a name is not a column of the table, or `given` is not a scalar expression.
    """
    columns = table.columns
    names = {name.casefold(): name for name in columns}
    if given.casefold() in names:
        name = names[given.casefold()]
        return Bound(quoted(name), columns[name], (name,), True)
    if _NAME.fullmatch(given):
        raise InputError(_missing(table, what, given))
    try:
        # DuckDB would read some names that are not columns as the current user or time.
        found = columns_of(connection, given)
        for name in found:
            if name.casefold() not in names:
                raise InputError(_missing(table, what, name))
        used = tuple(dict.fromkeys(names[name.casefold()] for name in found))
        like = ", ".join(f"CAST(NULL AS {columns[name]}) AS {quoted(name)}" for name in used)
        like = f"FROM (SELECT {like})" if like else ""
        try:
            sql = f"({given}\n)"
            described = connection.sql(f"DESCRIBE SELECT {sql} AS x {like}").fetchall()
        except duckdb.BinderException:
            truth = {name for name in used if columns[name] == "BOOLEAN"}
            sql = f"({with_numbers_for_truth_values(connection, given, truth)}\n)"
            if not truth:
                raise
            described = connection.sql(f"DESCRIBE SELECT {sql} AS x {like}").fetchall()
    except (duckdb.Error, NotScalarError) as error:
        raise refused(what, given, str(table.files[0]), first_line(error)) from None
    return Bound(sql, str(described[0][1]), used, False)


def _missing(table: Table, what: str, name: str) -> str:
    folded = {column.casefold(): column for column in table.columns}
    near = difflib.get_close_matches(name.casefold(), folded, n=3, cutoff=0.5)
    hint = ", ".join(folded[column] for column in near)
    hint = f"nearest: {hint}" if hint else f"it has {', '.join(table.columns)}"
    return f"{table.files[0]} has no column {name!r} ({what}); {hint}"


def wrong_type(table: Table, what: str, given: str, kind: str, wanted: str) -> InputError:
    """Error for a column of an unsupported type."""
    return InputError(f"{table.files[0]}: {what} ({given}) is {kind}; {wanted}")


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
    except (OSError, SafetensorError) as error:
        if not _is_disk_full(error):
            raise
        raise _disk_full(folder) from None
    except duckdb.Error as error:
        if _is_disk_full(error):
            raise _disk_full(folder) from None
        if isinstance(error, duckdb.OutOfMemoryException):
            raise InputError(f"{first_line(error)}; raise memory_limit") from None
        if fault := fault_of_line(error):
            raise fault from None
        for file, damage in _unreadable(connection, tables):
            raise fault_of_line(damage) or InputError(
                f"{file} cannot be read, it may be damaged ({first_line(damage)}); fetch it again"
            ) from None
        if isinstance(error, duckdb.InternalError):
            raise
        files = ", ".join(str(file) for table in tables for file in table.files[:3])
        raise InputError(
            f"{files}: {first_line(error)}; correct the values, or try_cast them in the mapping"
        ) from None


def _is_disk_full(error: Exception) -> bool:
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    # Messages of safetensors and DuckDB, of DuckDB's own disk limit, and of numpy.
    phrases = ("No space left", "max_temp_directory_size", "requested and")
    return any(phrase in str(error) for phrase in phrases)


def _disk_full(folder: Path) -> InputError:
    return InputError(f"no space left on the disk of {folder}; free space or write elsewhere")


def _unreadable(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table]
) -> Iterator[tuple[Path, duckdb.Error]]:
    for table in tables:
        for file in table.files:
            single = replace(table, files=(file,))
            try:
                connection.sql(f"SELECT max(hash(t)) FROM {single.sql} AS t").fetchall()
            except duckdb.Error as error:
                yield file, error


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
        self._names = [{name.casefold() for name in table.columns} for table in tables]

    def of(self, text: str) -> Table | None:
        """The first of them; None if all tables have what the column or expression reads."""
        for table, names in zip(self._tables, self._names, strict=True):
            if text.casefold() in names:
                continue
            if text.isidentifier():
                return table
            try:
                needed = columns_of(self._connection, text)
            except (duckdb.Error, NotScalarError):
                # It is refused where it is bound, with the reason.
                continue
            if not {name.casefold() for name in needed} <= names:
                return table
        return None
