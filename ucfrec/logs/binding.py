"""Log and feature files in DuckDB: opening, binding columns, explaining errors."""

import difflib
import errno
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import duckdb
from safetensors import SafetensorError

from ucfrec.errors import InputError
from ucfrec.files.parquet import require_plausible_rows
from ucfrec.logs.compressed import require_plausible_size
from ucfrec.logs.expressions import NotScalarError, columns_of, refused

_MAGIC = re.compile(r"[\[*?]")
_NAME = re.compile(r"[^\W\d]\w*")
_CSV_FAULT = re.compile(r"CSV Error on Line: (\d+).*?\n\s*file = ([^\n]+)", re.DOTALL)
_CSV_COLUMN = re.compile(r'converting column "([^"]+)"\. ([^\n]+)')
_INTEGER = re.compile(r"U?(TINY|SMALL|BIG|HUGE)?INT(EGER)?")
_REAL = re.compile(r"FLOAT|DOUBLE|DECIMAL.*")
_NARROW = re.compile(r"(U?(?:TINY|SMALL)INT|U?INTEGER)((?:\[\d*\])*)")
_NUMBERS = re.compile(r"(U?(TINY|SMALL|BIG|HUGE)?INT(EGER)?|FLOAT|DOUBLE|DECIMAL\(.*\))\[\d*\]")
_EXACT = {
    "BIGINT": "DOUBLE",
    "DATE": "TIMESTAMP",
    "TIMESTAMP": "TIMESTAMP WITH TIME ZONE",
}
"""DuckDB type of a CSV column to the type that keeps what a cast to it would cut off."""
_MAX_FAULT = 300
"""Most characters of a message of DuckDB, which may quote values of any length."""

MAX_FLOAT = 3.4028235e38


@dataclass(frozen=True)
class Table:
    """Files with the same columns, read one after the other as a single table."""

    files: tuple[Path, ...]
    types: tuple[tuple[str, str], ...]
    """(name, DuckDB type) of each column in the files."""

    @property
    def columns(self) -> dict[str, str]:
        """Column name to DuckDB type, as `sql` gives it."""
        return {name: _computed_as(kind) for name, kind in self.types}

    @property
    def columnar(self) -> bool:
        """Whether reading a column again is cheap, because text need not be parsed."""
        return self.files[0].suffix == ".parquet"

    @property
    def sql(self) -> str:
        """SQL of the rows: NaN is missing, integers of fewer than 64 bits have 64."""
        read = {name: _read(quoted(name), kind) for name, kind in self.types}
        changed = ", ".join(
            f"{sql} AS {quoted(name)}" for name, sql in read.items() if sql != quoted(name)
        )
        return f"(SELECT * REPLACE ({changed}) FROM {self.source})" if changed else self.source

    @property
    def source(self) -> str:
        """SQL call of the DuckDB table function that reads the files."""
        files = ", ".join(text(glob_pattern(file)) for file in self.files)
        if self.columnar:
            return f"read_parquet([{files}])"
        types = ", ".join(f"{text(name)}: {text(kind)}" for name, kind in self.types)
        return f"read_csv([{files}], header = true, types = {{{types}}})"


def _computed_as(kind: str) -> str:
    """The DuckDB type that expressions compute with, given that of a column.

    DuckDB multiplies two columns of 8 bits in 8 bits, and takes unsigned numbers from each other
    without a sign: where that overflows, a reward would be undefined.
    """
    if kind == "UBIGINT":
        return "HUGEINT"
    return _NARROW.sub(r"BIGINT\2", kind) if _NARROW.fullmatch(kind) else kind


def _read(column: str, kind: str) -> str:
    """SQL of a quoted column of a DuckDB type, as expressions compute with it."""
    if kind in ("FLOAT", "DOUBLE"):
        # To DuckDB, NaN is greater than every number: `score > 0.5` would hold. It would leave out
        # `isnan` here, because the extremes that a Parquet file states tell of no NaN.
        return f"CASE WHEN isfinite({column}) OR isinf({column}) THEN {column} END"
    wider = _computed_as(kind)
    return column if wider == kind else f"CAST({column} AS {wider})"


def glob_pattern(file: Path) -> str:
    """Glob pattern that matches only `file`: DuckDB treats every path as a pattern."""
    return _MAGIC.sub(r"[\g<0>]", str(file))


def text(value: str) -> str:
    """`value` as a SQL string literal."""
    return "'" + value.replace("'", "''") + "'"


def quoted(name: str) -> str:
    """`name` as a SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def is_integer(kind: str) -> bool:
    """Whether a DuckDB type holds whole numbers."""
    return _INTEGER.fullmatch(kind) is not None


def is_number(kind: str) -> bool:
    """Whether a DuckDB type holds numbers."""
    return is_integer(kind) or _REAL.fullmatch(kind) is not None


def is_vector(kind: str) -> bool:
    """Whether a DuckDB type holds lists of numbers."""
    return _NUMBERS.fullmatch(kind) is not None


def as_timestamp(sql: str, kind: str) -> str | None:
    """SQL of the TIMESTAMP in UTC that a date or time of a DuckDB type means; None for others."""
    if kind == "DATE" or kind.startswith("TIMESTAMP"):
        # DuckDB casts TIMESTAMPTZ_NS only by way of TIMESTAMPTZ.
        zoned = "TZ" in kind or "TIME ZONE" in kind
        return f"{sql}::TIMESTAMPTZ::TIMESTAMP" if zoned else f"{sql}::TIMESTAMP"
    return None


def open_tables(connection: duckdb.DuckDBPyConnection, files: Sequence[Path]) -> list[Table]:
    """Read the columns of every file and group consecutive files with equal columns.

    Returns:
        Tables in the order of `files`.

    Raises:
        InputError: a file is empty, truncated or not of the kind that its suffix says.
    """
    tables: list[Table] = []
    for file in files:
        opened = Table((file,), _columns(connection, file))
        like = (tables[-1].types, tables[-1].files[0].suffix) if tables else None
        if like == (opened.types, file.suffix):
            tables[-1] = Table((*tables[-1].files, file), opened.types)
        else:
            tables.append(opened)
    return tables


def _columns(connection: duckdb.DuckDBPyConnection, file: Path) -> tuple[tuple[str, str], ...]:
    if file.stat().st_size == 0:
        raise InputError(f"{file} is empty (0 bytes); remove it from the input or fetch it again")
    if "\\" in str(file) and _MAGIC.search(str(file)):
        raise InputError(
            f"{file} cannot be read: its path has a backslash and [, * or ?; rename it"
        )
    if file.suffix == ".gz":
        require_plausible_size(file)
    source = Table((file,), ()).source.replace(", types = {}", "")
    try:
        types = connection.sql(f"DESCRIBE SELECT * FROM {source}").fetchall()
        if file.suffix == ".parquet":
            metadata = f"parquet_file_metadata({text(glob_pattern(file))})"
            ((rows,),) = connection.sql(f"SELECT num_rows FROM {metadata}").fetchall()
            require_plausible_rows(file, rows)
        first_row = connection.sql(f"SELECT 1 FROM {source} LIMIT 1").fetchall()
    except duckdb.Error as error:
        raise InputError(
            f"{file} cannot be read, it may be truncated ({_first_line(error)}); fetch it again"
        ) from None
    if not first_row:
        raise InputError(f"{file} is empty (0 rows); remove it from the input or fetch it again")
    columns = tuple((str(name), str(kind)) for name, kind, *_ in types)
    return columns if file.suffix == ".parquet" else _of_all_rows(connection, file, columns)


def _of_all_rows(
    connection: duckdb.DuckDBPyConnection, file: Path, types: tuple[tuple[str, str], ...]
) -> tuple[tuple[str, str], ...]:
    """Types of the columns of a CSV file, given those that DuckDB told from its first rows.

    In later rows it would round 0.25 to a whole number, and cut the hour off a date, without an
    error. For values of another kind there is one, when they are read.
    """
    exact = {name: _EXACT[kind] for name, kind in types if kind in _EXACT}
    if not exact:
        return types
    as_text = Table((file,), tuple((n, "VARCHAR" if n in exact else kind) for n, kind in types))
    source = f"{as_text.source[:-1]}, ignore_errors = true)"
    lossy = ", ".join(
        f"bool_or(TRY_CAST({quoted(name)} AS {exact[name]}) <> TRY_CAST({quoted(name)} AS {kind}))"
        for name, kind in types
        if name in exact
    )
    try:
        (row,) = connection.sql(f"SELECT {lossy} FROM {source}").fetchall()
    except duckdb.Error:
        return types  # reading the rows tells what is wrong with the file
    wider = {name for name, lost in zip(exact, row, strict=True) if lost}
    return tuple((name, exact[name] if name in wider else kind) for name, kind in types)


def bind(
    connection: duckdb.DuckDBPyConnection, table: Table, what: str, given: str
) -> tuple[str, str]:
    """Resolve a column name or scalar expression against the columns of `table`.

    Args:
        what: purpose of the expression, for messages.
        given: column name (case does not matter) or SQL expression.

    Returns:
        The SQL and its DuckDB type.

    Raises:
        InputError: a name is not a column of the table, or `given` is not a scalar expression.
    """
    names = {name.casefold(): name for name in table.columns}
    if given.casefold() in names:
        name = names[given.casefold()]
        return quoted(name), table.columns[name]
    if _NAME.fullmatch(given):
        raise InputError(_missing(table, what, given))
    sql = f"({given}\n)"
    like = ", ".join(
        f"CAST(NULL AS {kind}) AS {quoted(name)}" for name, kind in table.columns.items()
    )
    try:
        # DuckDB would read some names that are not columns as the current user or time.
        used = columns_of(connection, given)
        for name in used:
            if name.casefold() not in names:
                raise InputError(_missing(table, what, name))
        described = connection.sql(f"DESCRIBE SELECT {sql} AS x FROM (SELECT {like})").fetchall()
    except (duckdb.Error, NotScalarError) as error:
        raise refused(what, given, str(table.files[0]), _first_line(error)) from None
    return sql, str(described[0][1])


def _missing(table: Table, what: str, name: str) -> str:
    folded = {column.casefold(): column for column in table.columns}
    near = difflib.get_close_matches(name.casefold(), folded, n=3, cutoff=0.5)
    hint = ", ".join(folded[column] for column in near)
    hint = f"nearest: {hint}" if hint else f"it has {', '.join(table.columns)}"
    return f"{table.files[0]} has no column {name!r} ({what}); {hint}"


def wrong_type(table: Table, what: str, given: str, kind: str, wanted: str) -> InputError:
    """Error for a column of an unsupported type.

    Args:
        what: log column or feature.
        given: its column name or expression.
        kind: its DuckDB type.
        wanted: remedy, for the message.
    """
    return InputError(f"{table.files[0]}: {what} ({given}) is {kind}; {wanted}")


@contextmanager
def explained(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], folder: Path
) -> Iterator[None]:
    """Turn errors of files, memory and disk that occur in the block into `InputError`.

    Args:
        tables: tables that the block reads.
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
            raise InputError(f"{_first_line(error)}; raise memory_limit") from None
        if fault := _CSV_FAULT.search(message):
            column = _CSV_COLUMN.search(message)
            detail = f"column {column[1]}: {column[2]}" if column else _first_line(error)
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
            f"{files}: {_first_line(error)}; correct the values, or try_cast them in the mapping"
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
            single = Table((file,), table.types)
            try:
                connection.sql(f"SELECT max(hash(t)) FROM {single.sql} AS t").fetchall()
            except duckdb.Error as error:
                yield file, _first_line(error)


def _first_line(error: Exception) -> str:
    return f"{str(error).splitlines()[0]:.{_MAX_FAULT}}"
