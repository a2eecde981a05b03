"""Log and feature files as tables of DuckDB: what is in a file is what counts.

No column comes from the name of a folder unless it is requested, parts of one table may have their
columns in any order, and text that looks like a number stays available as text (`Table.raw`).
"""

import contextlib
import csv
import gzip
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TextIO, cast

import duckdb
import pyarrow.parquet as pq

from ucfrec.errors import InputError
from ucfrec.files.parquet import require_plausible_rows
from ucfrec.logs.compressed import require_plausible_size, require_short_lines

_MAGIC = re.compile(r"[\[*?]")
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
NOTHING: Final = '"NULL"'
"""DuckDB type of a column without any value."""
ISO_TIME: Final = (
    r"\d{4}[-/]\d{1,2}[-/]\d{1,2}"
    r"([T ]\d{1,2}:\d{1,2}(:\d{1,2}([.,]\d+)?)?\s*(Z|UTC|[+-]\d{2}(:?\d{2})?)?)?"
)
"""Times that have one meaning: the year comes first."""
PANDAS_INDEX: Final = re.compile(r"__index_level_\d+__")
"""Column in which pandas keeps the numbers of the rows of a frame: no data."""
_NO_VALUE: Final = "__HIVE_DEFAULT_PARTITION__"
"""Value of a column in the name of a folder whose rows have none."""
_FILE: Final = "ucfrec: file"
_RAW: Final = "ucfrec: text of "

MAX_FLOAT = 3.4028235e38


@dataclass(frozen=True)
class Table:
    """Files with the same columns, read one after the other as a single table."""

    files: tuple[Path, ...]
    types: tuple[tuple[str, str], ...]
    """(name, DuckDB type) of each column in the files."""
    partitions: tuple[tuple[str, str], ...] = ()
    """(name, DuckDB type) of the columns that are read from the names of folders."""
    used: tuple[str, ...] | None = None
    """Columns that are read; None for all."""
    raw: tuple[str, ...] = ()
    """Columns of CSV files that are read as text, too, as the columns `raw_name` of them."""

    @property
    def columns(self) -> dict[str, str]:
        """Column name to DuckDB type, as `sql` gives it."""
        return {name: _computed_as(kind) for name, kind in (*self.types, *self.partitions)}

    @property
    def columnar(self) -> bool:
        """Whether reading a column again is cheap, because text need not be parsed."""
        return self.files[0].suffix.lower() == ".parquet"

    def of(self, used: Iterable[str], raw: Iterable[str] = ()) -> "Table":
        """The same table with some of its columns, so that others cost nothing."""
        return replace(self, used=tuple(dict.fromkeys(used)), raw=tuple(dict.fromkeys(raw)))

    def with_texts(self, used: Iterable[str], texts: Iterable[str]) -> "Table":
        """The same table with more columns, and with those that `text_of` needs."""
        used = [*(self.used or ()), *used]
        if self.columnar:
            return self.of([*used, *texts], self.raw)
        return self.of(used, [*self.raw, *texts])

    def text_of(self, name: str) -> str:
        """SQL of the text of a column; that of a CSV file is what the file says: 007 is not 7."""
        return f"CAST({quoted(name if self.columnar else raw_name(name))} AS VARCHAR)"

    @property
    def sql(self) -> str:
        """SQL of the rows: NaN is missing, integers of fewer than 64 bits have 64."""
        kinds = dict(self.types)
        names = kinds if self.used is None else [name for name in self.used if name in kinds]
        read = [self._value(name, kinds[name]) for name in names]
        read += [f"{quoted(name)} AS {quoted(raw_name(name))}" for name in self.raw]
        read += [
            f"{_of_folder(name, kind)} AS {quoted(name)}"
            for name, kind in self.partitions
            if self.used is None or name in self.used
        ]
        return f"(SELECT {', '.join(read) or '1'} FROM {self.source})"

    def _value(self, name: str, kind: str) -> str:
        column = quoted(name)
        if name in self.raw and kind != "VARCHAR":
            column = f"CAST({column} AS {kind})"
        read = _read(column, kind)
        return read if read == quoted(name) else f"{read} AS {quoted(name)}"

    @property
    def source(self) -> str:
        """SQL call of the DuckDB table function that reads the files."""
        files = ", ".join(text(glob_pattern(file)) for file in self.files)
        options = "hive_partitioning = false"
        if self.partitions:
            options += f", filename = {text(_FILE)}"
        if self.columnar:
            return f"read_parquet([{files}], {options})"
        kinds = {name: "VARCHAR" if name in self.raw else kind for name, kind in self.types}
        kinds = {name: "VARCHAR" if kind == NOTHING else kind for name, kind in kinds.items()}
        types = ", ".join(f"{text(name)}: {text(kind)}" for name, kind in kinds.items())
        given = f", types = {{{types}}}" if types else ""
        # DuckDB would take quotes for text if the first rows have none, and sometimes leave out
        # lines that begin with #.
        options += ", quote = '\"', escape = '\"', comment = ''"
        return f"read_csv([{files}], header = true, {options}{given})"


def raw_name(name: str) -> str:
    """Name of the text of a column, see `Table.raw`."""
    return _RAW + name


def _of_folder(name: str, kind: str = "VARCHAR") -> str:
    """SQL of the value of a column in the name of a folder."""
    pattern = f"(?:^|[/\\\\]){re.escape(name)}=([^/\\\\]*)[/\\\\]"
    value = f"url_decode(regexp_extract({quoted(_FILE)}, {text(pattern)}, 1))"
    return f"CAST(nullif({value}, {text(_NO_VALUE)}) AS {kind})"


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
        # To DuckDB, NaN is greater than every number: `score > 0.5` would hold. It would exclude
        # `isnan` here, because the extremes that a Parquet file states show no NaN.
        return f"CASE WHEN isfinite({column}) OR isinf({column}) THEN {column} END"
    if kind == NOTHING:
        return "NULL"
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


def first_and_more(files: Sequence[Path]) -> str:
    """The first file, and how many more there are, for messages."""
    return str(files[0]) + (f" and {len(files) - 1} more" if len(files) > 1 else "")


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


def open_tables(
    connection: duckdb.DuckDBPyConnection, files: Sequence[Path], partitions: bool = False
) -> list[Table]:
    """Read the columns of every file and group consecutive files with equal columns.

    Files without rows are excluded, if others have some.

    Args:
        partitions: read columns from the names of folders, such as `date=2026-08-01`.

    Returns:
        Tables in the order of `files`.

    Raises:
        InputError: a file is truncated or not of the kind that its suffix says, no file has a row,
            or a file has another value in a column than its folder says.
    """
    tables: list[Table] = []
    for file in files:
        columns = _columns(connection, file)
        if columns is None:
            continue
        opened = Table((file,), columns)
        if partitions:
            opened = replace(opened, partitions=_partitions(connection, opened))
        like = replace(tables[-1], files=opened.files) if tables else None
        if like == opened and tables[-1].files[0].suffix == file.suffix:
            tables[-1] = replace(opened, files=(*tables[-1].files, file))
        else:
            tables.append(opened)
    if not tables:
        raise InputError(
            f"{first_and_more(files)} is empty (0 rows); remove it from the input or fetch it again"
        )
    return _with_whole_numbers(tables)


def _partitions(connection: duckdb.DuckDBPyConnection, table: Table) -> tuple[tuple[str, str], ...]:
    """Columns that only the folders of a file name."""
    (file,) = table.files
    found = [part.partition("=")[0] for part in file.parts[:-1] if "=" in part.strip("=")]
    columns = {name.casefold(): name for name in table.columns}
    for name in [name for name in found if name.casefold() in columns]:
        column = columns[name.casefold()]
        named = replace(table, partitions=((name, "VARCHAR"),)).source
        differs = f"CAST({quoted(column)} AS VARCHAR) IS DISTINCT FROM {_of_folder(name)}"
        other = connection.sql(
            f"SELECT CAST({quoted(column)} AS VARCHAR) FROM {named} WHERE {differs} LIMIT 1"
        ).fetchall()
        if other:
            raise InputError(
                f"{file}: {column} is {other[0][0]!r:.60} in the file, but its folder says another "
                "value; omit --partitions, or rename the folders"
            )
    return tuple((name, "VARCHAR") for name in found if name.casefold() not in columns)


def _with_whole_numbers(tables: list[Table]) -> list[Table]:
    """Make columns of folders whole numbers, if the names of all folders are."""
    folders = [
        part.split("=", 1)
        for table in tables
        for file in table.files
        for part in file.parts[:-1]
        if "=" in part.strip("=")
    ]
    whole = rf"0|-?[1-9]\d{{0,17}}|{_NO_VALUE}"
    words = {name for name, value in folders if not re.fullmatch(whole, value)}
    return [
        replace(
            table,
            partitions=tuple(
                (name, "VARCHAR" if name in words else "BIGINT") for name, _ in table.partitions
            ),
        )
        for table in tables
    ]


def _columns(
    connection: duckdb.DuckDBPyConnection, file: Path
) -> tuple[tuple[str, str], ...] | None:
    """(name, DuckDB type) of the columns of a file; None if it has no rows."""
    is_parquet = file.suffix.lower() == ".parquet"
    if file.stat().st_size == 0:
        if not is_parquet:
            return None
        raise InputError(f"{file} is empty (0 bytes); remove it from the input or fetch it again")
    if "\\" in str(file) and _MAGIC.search(str(file)):
        raise InputError(
            f"{file} cannot be read: its path has a backslash and [, * or ?; rename it"
        )
    if file.suffix.lower() == ".gz":
        require_plausible_size(file)
    if not is_parquet:
        require_short_lines(file)
    source = Table((file,), ()).source
    try:
        types = connection.sql(f"DESCRIBE SELECT * FROM {source}").fetchall()
        if is_parquet:
            metadata = f"parquet_file_metadata({text(glob_pattern(file))})"
            ((rows,),) = connection.sql(f"SELECT num_rows FROM {metadata}").fetchall()
            require_plausible_rows(file, rows)
        first_row = connection.sql(f"SELECT 1 FROM {source} LIMIT 1").fetchall()
    except duckdb.Error as error:
        if "not utf-8 encoded" in str(error):
            raise InputError(
                f"{file} is not in UTF-8; convert it, e.g. with iconv -t UTF-8"
            ) from None
        raise InputError(
            f"{file} cannot be read, it may be truncated ({first_line(error)}); fetch it again"
        ) from None
    columns = tuple((str(name), str(kind)) for name, kind, *_ in types)
    names = [name for name, _ in columns]
    if not is_parquet:
        _require_header(file, names)
    if not first_row:
        return None
    _require_distinct(file, names)
    return columns if is_parquet else _of_all_rows(connection, file, columns)


def _require_header(file: Path, columns: Sequence[str]) -> None:
    """Refuse a CSV file whose first line is no header, or whose lines have other numbers of fields:
    DuckDB reads such a file as one column, or skips lines."""
    first = _written_names(file)
    numbers = sum(re.fullmatch(r"[-+]?\d+(\.\d+)?", name) is not None for name in first)
    if 2 * numbers >= len(first):
        raise InputError(
            f"{file}, line 1 has values ({', '.join(first):.60}) instead of the names of the "
            "columns; add a line with these"
        )
    if len(columns) == len(first):
        return
    with _opened(file) as lines, contextlib.suppress(csv.Error):
        separator = max(",;\t|", key=lines.readline().count)
        lines.seek(0)
        rows = csv.reader(lines, delimiter=separator)
        header = next(rows, [])
        for number, row in enumerate(rows, start=2):
            # A first line of one field is a title or comment, which DuckDB skips.
            if row and len(row) != len(header) > 1:
                raise InputError(
                    f"{file}, line {number} has {len(row)} fields, the header {len(header)}; fix "
                    "or remove the line"
                )


def _opened(file: Path) -> TextIO:
    kind = gzip.open if file.suffix.lower() == ".gz" else open
    return cast(TextIO, kind(file, "rt", encoding="utf-8-sig", errors="replace"))


def _require_distinct(file: Path, columns: Sequence[str]) -> None:
    """Refuse a file with two columns of one name; DuckDB calls the second of `x` `x_1`."""
    folded = {name.casefold() for name in columns}
    second = [n for n in columns if n.endswith("_1") and n[:-2].casefold() in folded]
    for name in set(second).difference(_written_names(file) if second else ()):
        raise InputError(f"{file} has more than one column {name[:-2]}; rename or remove one")


def _written_names(file: Path) -> list[str]:
    """Names of the columns as the file has them."""
    if file.suffix.lower() == ".parquet":
        return list(pq.read_schema(file).names)
    with _opened(file) as lines:
        return [name.strip(" \"'\r\n") for name in re.split(r"[,;\t|]", lines.readline())]


def _of_all_rows(
    connection: duckdb.DuckDBPyConnection, file: Path, types: tuple[tuple[str, str], ...]
) -> tuple[tuple[str, str], ...]:
    """Types of the columns of a CSV file, given those that DuckDB inferred from its first rows.

    In later rows it would round 0.25 to a whole number, take 007 for 7, and cut the hour off a
    date, without an error. For values of another kind there is one, when they are read. Dates that
    do not begin with the year stay text: DuckDB guesses their order. A column without any value has
    the type `NOTHING`.
    """
    exact = {name: _EXACT[kind] for name, kind in types if kind in _EXACT}
    dated = [name for name, kind in types if kind == "DATE" or kind.startswith("TIMESTAMP")]
    whole = [name for name, kind in types if kind == "BIGINT"]
    words = _never_filled(connection, file, types)
    asked = dict.fromkeys([*exact, *dated])
    if not asked and not words:
        return types
    as_text = Table((file,), tuple((n, "VARCHAR" if n in asked else kind) for n, kind in types))
    source = f"{as_text.source[:-1]}, ignore_errors = true)"
    kinds = dict(types)
    conditions = [
        f"TRY_CAST({quoted(n)} AS {wide}) <> TRY_CAST({quoted(n)} AS {kinds[n]})"
        for n, wide in exact.items()
    ]
    conditions += [f"NOT regexp_full_match(trim({quoted(n)}), {text(ISO_TIME)})" for n in dated]
    conditions += [f"regexp_full_match({quoted(n)}, '-?0\\d+')" for n in whole]
    conditions += [f"{quoted(n)} IS NOT NULL" for n in words]
    every = ", ".join(f"coalesce(bool_or({each}), false)" for each in conditions)
    try:
        (row,) = connection.sql(f"SELECT {every} FROM {source}").fetchall()
    except duckdb.Error:
        return types  # reading the rows shows what is wrong with the file
    told = iter(row)
    changed = {name: exact[name] for name in exact if next(told)}
    changed |= {name: "VARCHAR" for name in (*dated, *whole) if next(told)}
    changed |= {name: NOTHING for name in words if not next(told)}
    return tuple((name, changed.get(name, kind)) for name, kind in types)


def _never_filled(
    connection: duckdb.DuckDBPyConnection, file: Path, types: tuple[tuple[str, str], ...]
) -> list[str]:
    """Columns of text without a value in the first rows of a CSV file."""
    words = [name for name, kind in types if kind == "VARCHAR"]
    if not words:
        return []
    some = ", ".join(f"count({quoted(name)})" for name in words)
    source = f"{Table((file,), types).source[:-1]}, ignore_errors = true)"
    try:
        (row,) = connection.sql(f"SELECT {some} FROM (FROM {source} LIMIT 1000)").fetchall()
    except duckdb.Error:
        return []
    return [name for name, count in zip(words, row, strict=True) if not count]


def first_line(error: Exception) -> str:
    """The first line of a message, cut off where it is long."""
    return f"{str(error).splitlines()[0]:.{_MAX_FAULT}}"
