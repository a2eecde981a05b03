"""Bind columns and expressions to the columns of tables, and explain errors of files."""

import difflib
import errno
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import duckdb
from safetensors import SafetensorError

from ucfrec.errors import InputError
from ucfrec.logs.expressions import (
    NotScalarError,
    columns_of,
    refused,
    with_numbers_for_truth_values,
)
from ucfrec.logs.tables import Table, first_line, quoted

_NAME = re.compile(r"[^\W\d]\w*")
_CSV_FAULT = re.compile(r"CSV Error on Line: (\d+).*?\n\s*file = ([^\n]+)", re.DOTALL)
_CSV_COLUMN = re.compile(r'converting column "([^"]+)"\. ([^\n]+)')
_MAX_FAULT: Final = 300
"""Most characters of a message of DuckDB, which may quote values of any length."""


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
        message = str(error)
        if _is_disk_full(error):
            raise _disk_full(folder) from None
        if isinstance(error, duckdb.OutOfMemoryException):
            raise InputError(f"{first_line(error)}; raise memory_limit") from None
        if fault := _CSV_FAULT.search(message):
            column = _CSV_COLUMN.search(message)
            detail = f"column {column[1]}: {column[2]}" if column else first_line(error)
            raise InputError(
                f"{fault[2]}, line {fault[1]}: {detail:.{_MAX_FAULT}}; correct the line, or write "
                "the log as Parquet, where a column states its type"
            ) from None
        for file, fault_line in _unreadable(connection, tables):
            raise InputError(
                f"{file} cannot be read, it may be damaged ({fault_line}); fetch it again"
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
) -> Iterator[tuple[Path, str]]:
    for table in tables:
        for file in table.files:
            single = replace(table, files=(file,))
            try:
                connection.sql(f"SELECT max(hash(t)) FROM {single.sql} AS t").fetchall()
            except duckdb.Error as error:
                yield file, first_line(error)
