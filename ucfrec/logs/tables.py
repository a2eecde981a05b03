"""Log and feature files as tables of DuckDB: what is in a file is what counts.

No column comes from the name of a folder unless it is requested, parts of one table may have their
columns in any order, and text that looks like a number stays available as text (`Table.raw`).
"""

import contextlib
import csv
import glob
import gzip
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TextIO, cast

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.files.parquet import require_plausible_rows

_INTEGER = re.compile(r"U?(TINY|SMALL|BIG|HUGE)?INT(EGER)?")
_REAL = re.compile(r"FLOAT|DOUBLE|DECIMAL.*")
_NARROW = re.compile(r"^(U?(?:TINY|SMALL)INT|U?INTEGER)((?:\[\d*\])*)$")
_WIDE = re.compile(r"^(UBIGINT|DECIMAL\(\d+,0\))((?:\[\d*\])*)$")
_NUMBERS = re.compile(r"(U?(TINY|SMALL|BIG|HUGE)?INT(EGER)?|FLOAT|DOUBLE|DECIMAL\(.*\))\[\d*\]")
_EXACT = {"BIGINT": "DOUBLE", "DATE": "TIMESTAMP", "TIMESTAMP": "TIMESTAMP WITH TIME ZONE"}
"""DuckDB type of a CSV column to the type that keeps what a cast to it would cut off."""
_CSV_FAULT = re.compile(
    r"CSV Error on Line: (\d+)(?:\nOriginal Line: .*)?\n(.*)(?:.|\n)*?\n\s*file = (.+)"
)
_CSV_COLUMN = re.compile(r'converting column "([^"]+)"\. ([^\n]+)')
_MAX_FAULT = 300
"""Most characters of a message of DuckDB, which may quote values of any length."""
_MOST_NESTED = 32
"""Most levels of a Parquet column; a list is two, and DuckDB's time doubles with each list."""
_NESTED_TOO_DEEP = "schema too deeply nested"  # Arrow's words
NOTHING = '"NULL"'
"""DuckDB type of a column without any value."""
ISO_TIME = (
    r"\d{4}[-/]\d{1,2}[-/]\d{1,2}"
    r"([T ]\d{1,2}:\d{1,2}(:\d{1,2}([.,]\d+)?)?\s*(Z|UTC|[+-]\d{2}(:?\d{2})?)?)?"
)
"""Times that have one meaning: the year comes first."""
EXPOSED = (schema.POSITION, schema.PROPENSITY, schema.RUN, schema.RULE)
"""Columns that together only exposures have, and logs that `join` made of them."""
PANDAS_INDEX = re.compile(r"__index_level_\d+__")
"""Column in which pandas keeps the numbers of the rows of a frame: no data."""
_NO_VALUE = "__HIVE_DEFAULT_PARTITION__"
"""Value of a column in the name of a folder whose rows have none."""
_FILE = "ucfrec: file"
_RAW = "ucfrec: text of "

MAX_FLOAT = 3.4028235e38
WHOLE = {"FLOAT": 2**24, "DOUBLE": 2**53}
"""DuckDB type of reals to the bound below which it holds every whole number."""


@dataclass(frozen=True)
class Table:
    """Files with the same columns, read one after the other as a single table."""

    files: tuple[Path, ...]
    types: tuple[tuple[str, str], ...]
    """(name, DuckDB type) of each column in the files."""
    partitions: tuple[tuple[str, str], ...] = ()
    """(name, DuckDB type) of the columns that are read from the names of folders."""
    selected: tuple[str, ...] | None = None
    """Columns that are read; None for all."""
    raw: tuple[str, ...] = ()
    """Columns of CSV files that are read as text, too, as the columns `raw_name` of them."""

    @property
    def columns(self) -> dict[str, str]:
        """Column name to DuckDB type, as `sql` gives it."""
        return {name: _wider_type(kind) for name, kind in (*self.types, *self.partitions)}

    @property
    def columnar(self) -> bool:
        """Whether reading a column again is cheap, because text need not be parsed."""
        return self.files[0].suffix.lower() == ".parquet"

    @property
    def of_exposures(self) -> bool:
        """Whether they have the columns of exposures, as a log of `join` has."""
        return {*EXPOSED} <= {name.casefold() for name in self.columns}

    def of(self, selected: Iterable[str], raw: Iterable[str] = ()) -> "Table":
        """The same table with some of its columns, so that others cost nothing."""
        return replace(self, selected=tuple(dict.fromkeys(selected)), raw=tuple(dict.fromkeys(raw)))

    def add_texts(self, selected: Iterable[str], texts: Iterable[str]) -> "Table":
        """The same table with more columns, and with those that `text_of` needs."""
        selected = [*(self.selected or ()), *selected]
        if self.columnar:
            return self.of([*selected, *texts], self.raw)
        return self.of(selected, [*self.raw, *texts])

    def text_of(self, name: str) -> str:
        """SQL of the text of a column; of a CSV file as written: 007 is not 7."""
        return f"CAST({quote_name(name if self.columnar else raw_name(name))} AS VARCHAR)"

    @property
    def sql(self) -> str:
        """SQL of the rows: NaN is missing, integers of fewer than 64 bits have 64."""
        kinds, folders = dict(self.types), dict(self.partitions)
        selected = [*kinds, *folders] if self.selected is None else self.selected
        values = []
        for name in (name for name in selected if name in kinds):
            column, kind = quote_name(name), kinds[name]
            if name in self.raw and kind != "VARCHAR":
                column = f"CAST({column} AS {kind})"
            if kind in ("FLOAT", "DOUBLE"):
                # To DuckDB, NaN is greater than every number: `score > 0.5` would hold. It would
                # exclude `isnan` here, as the extremes that a Parquet file states show no NaN.
                column = f"CASE WHEN isfinite({column}) OR isinf({column}) THEN {column} END"
            elif kind == NOTHING:
                column = "NULL"
            elif (wider := _wider_type(kind)) != kind:
                column = f"CAST({column} AS {wider})"
            values.append(f"{column} AS {quote_name(name)}")
        values += [f"{quote_name(name)} AS {quote_name(raw_name(name))}" for name in self.raw]
        values += [
            f"{_folder_value(name, folders[name])} AS {quote_name(name)}"
            for name in selected
            if name in folders
        ]
        return f"(SELECT {', '.join(values) or '1'} FROM {self.source})"

    @property
    def source(self) -> str:
        """SQL call of the DuckDB table function that reads the files."""
        files = ", ".join(quote(glob_pattern(file)) for file in self.files)
        options = "hive_partitioning = false"
        if self.partitions:
            options += f", filename = {quote(_FILE)}"
        if self.columnar:
            return f"read_parquet([{files}], {options})"
        types = ", ".join(
            f"{quote(name)}: {quote('VARCHAR' if name in self.raw or kind == NOTHING else kind)}"
            for name, kind in self.types
        )
        # DuckDB would take quotes for text if the first rows have none, and sometimes leave out
        # lines that begin with #.
        options += ", quote = '\"', escape = '\"', comment = ''"
        options += f", types = {{{types}}}" if types else ""
        return f"read_csv([{files}], header = true, {options})"


def raw_name(name: str) -> str:
    """Name of the text of a column, see `Table.raw`."""
    return _RAW + name


def _folder_value(name: str, kind: str = "VARCHAR") -> str:
    """SQL of the value of a column in the name of a folder."""
    pattern = f"(?:^|[/\\\\]){re.escape(name)}=([^/\\\\]*)[/\\\\]"
    value = f"url_decode(regexp_extract({quote_name(_FILE)}, {quote(pattern)}, 1))"
    return f"CAST(nullif({value}, {quote(_NO_VALUE)}) AS {kind})"


def _wider_type(kind: str) -> str:
    """The type that expressions compute with: DuckDB multiplies 8 bits in 8 bits, and subtracts
    unsigned numbers without a sign; where that overflows, a reward would be undefined. Decimals
    without a fraction are whole numbers, as some databases write them."""
    return _NARROW.sub(r"BIGINT\2", _WIDE.sub(r"HUGEINT\2", kind))


def glob_pattern(file: Path) -> str:
    """Glob pattern that matches only `file`: DuckDB treats every path as a pattern."""
    # Of "~" at the begin, it would make the folder of the user.
    return re.sub("^~", "./~", glob.escape(str(file)))


def quote(value: str) -> str:
    """`value` as a SQL string literal."""
    return "'" + value.replace("'", "''") + "'"


def quote_name(name: str) -> str:
    """`name` as a SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def cast_integer(text: str) -> str:
    """SQL of the BIGINT that a text (SQL) is written as; NULL for others: 007 is not 7."""
    number = f"TRY_CAST({text} AS BIGINT)"
    return f"CASE WHEN CAST({number} AS VARCHAR) = CAST({text} AS VARCHAR) THEN {number} END"


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


def cast_timestamp(sql: str, kind: str) -> str | None:
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

    Files without rows are excluded, if others have some. With `partitions`, names of folders such
    as `date=2026-08-01` give columns. Raises InputError if a file is truncated or not of the kind
    that its suffix says, no file has a row, or a column has another value than the folder says.
    """
    singles = []
    for file in files:
        if columns := _columns(connection, file):
            single = Table((file,), columns)
            folders = _partitions(connection, single) if partitions else ()
            singles.append(replace(single, partitions=folders))
    tables = [
        replace(first, files=(*first.files, *(table.files[0] for table in more)))
        for first, *more in (
            [*group]
            for _, group in groupby(singles, lambda t: (t.types, t.partitions, t.files[0].suffix))
        )
    ]
    if not tables:
        raise InputError(
            f"{first_and_more(files)} is empty (0 rows); remove it from the input or fetch it again"
        )
    # Columns of folders are whole numbers, if the names of all folders are.
    whole = re.compile(rf"0|-?[1-9]\d{{0,17}}|{_NO_VALUE}")
    values = [pair for table in tables for file in table.files for pair in _folder_values(file)]
    words = {name for name, value in values if not whole.fullmatch(value)}
    for n, table in enumerate(tables):
        kinds = ((name, "VARCHAR" if name in words else "BIGINT") for name, _ in table.partitions)
        tables[n] = replace(table, partitions=tuple(kinds))
    return tables


def _partitions(connection: duckdb.DuckDBPyConnection, table: Table) -> tuple[tuple[str, str], ...]:
    """Columns that only the folders of a file name."""
    (file,) = table.files
    columns = {name.casefold(): name for name in table.columns}
    names = [name for name, _ in _folder_values(file)]
    for name in names:
        column = columns.get(name.casefold())
        if column is None:
            continue
        source = replace(table, partitions=((name, "VARCHAR"),)).source
        value = f"CAST({quote_name(column)} AS VARCHAR)"
        differing = connection.sql(
            f"SELECT {value} FROM {source} WHERE {value} IS DISTINCT FROM {_folder_value(name)} "
            "LIMIT 1"
        ).fetchall()
        if differing:
            raise InputError(
                f"{file}: {column} is {differing[0][0]!r:.60} in the file, but its folder says "
                "another value; omit --partitions, or rename the folders"
            )
    return tuple((name, "VARCHAR") for name in names if name.casefold() not in columns)


def _folder_values(file: Path) -> list[tuple[str, str]]:
    """Names and values of the folders of a file that are called NAME=VALUE."""
    pairs = [part.partition("=") for part in file.parts[:-1] if "=" in part.strip("=")]
    return [(name, value) for name, _, value in pairs]


def _columns(
    connection: duckdb.DuckDBPyConnection, file: Path
) -> tuple[tuple[str, str], ...] | None:
    """(name, DuckDB type) of the columns of a file; None if it has no rows."""
    is_parquet = file.suffix.lower() == ".parquet"
    if file.stat().st_size == 0:
        if not is_parquet:
            return None
        raise InputError(f"{file} is empty (0 bytes); remove it from the input or fetch it again")
    source = Table((file,), ()).source
    try:
        if is_parquet:
            metadata = pq.read_metadata(file)
            require_plausible_rows(file, metadata.num_rows)
            paths = (metadata.schema.column(n).path for n in range(metadata.num_columns))
            if any(path.count(".") > _MOST_NESTED for path in paths):
                raise OSError(_NESTED_TOO_DEEP)
        types = connection.sql(f"DESCRIBE SELECT * FROM {source}").fetchall()
        first_row = connection.sql(f"SELECT 1 FROM {source} LIMIT 1").fetchall()
    except (duckdb.Error, pa.ArrowException, OSError) as error:
        if _NESTED_TOO_DEEP in str(error):
            raise InputError(
                f"{file}: a column has lists in lists, more than {_MOST_NESTED // 2} levels deep; "
                "flatten or remove it"
            ) from None
        if "not utf-8 encoded" in str(error):
            raise InputError(
                f"{file} is not in UTF-8; convert it, e.g. with iconv -t UTF-8"
            ) from None
        raise fault_of_line(error) or InputError(
            f"{file} cannot be read, it may be truncated ({first_line(error)}); fetch it again"
        ) from None
    columns = tuple((str(name), str(kind)) for name, kind, *_ in types)
    names = [name for name, _ in columns]
    if not is_parquet:
        _require_header(file, names)
    if not first_row:
        return None
    # DuckDB calls the second of two columns `x` `x_1`.
    folded = {name.casefold() for name in names}
    second = [n for n in names if n.endswith("_1") and n[:-2].casefold() in folded]
    for name in set(second).difference(_written_names(file) if second else ()):
        raise InputError(f"{file} has more than one column {name[:-2]}; rename or remove one")
    return columns if is_parquet else _types_of_all_rows(connection, file, columns)


def _require_header(file: Path, columns: Sequence[str]) -> None:
    """Refuse a CSV file whose first line is no header, or whose lines have other numbers of fields:
    DuckDB reads such a file as one column, or skips lines."""
    names = _written_names(file)
    numbers = sum(re.fullmatch(r"[-+]?\d+(\.\d+)?", name) is not None for name in names)
    if 2 * numbers >= len(names):
        raise InputError(
            f"{file}, line 1 has values ({', '.join(names):.60}) instead of the names of the "
            "columns; add a line with these"
        )
    if len(columns) == len(names):
        return
    with _open_text(file) as lines, contextlib.suppress(csv.Error):
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


def _open_text(file: Path) -> TextIO:
    opener = gzip.open if file.suffix.lower() == ".gz" else open
    return cast(TextIO, opener(file, "rt", encoding="utf-8-sig", errors="replace"))


def _written_names(file: Path) -> list[str]:
    """Names of the columns as the file has them."""
    if file.suffix.lower() == ".parquet":
        return list(pq.read_schema(file).names)
    with _open_text(file) as lines:
        return [name.strip(" \"'\r\n") for name in re.split(r"[,;\t|]", lines.readline())]


def _types_of_all_rows(
    connection: duckdb.DuckDBPyConnection, file: Path, types: tuple[tuple[str, str], ...]
) -> tuple[tuple[str, str], ...]:
    """Types of the columns of a CSV file, given those that DuckDB inferred from its first rows.

    In later rows it would round 0.25 to a whole number, take 007 for 7, and cut the hour off a
    date, without an error. Dates that do not begin with the year stay text: DuckDB guesses their
    order. A column without any value has the type `NOTHING`.
    """
    kinds = dict(types)
    changes: list[tuple[str, str, str]] = []
    for name, kind in types:
        column = quote_name(name)
        if kind == "VARCHAR":
            changes.append((name, NOTHING, f"count({column}) = 0"))
        if kind in _EXACT:
            differs = f"TRY_CAST({column} AS {_EXACT[kind]}) <> TRY_CAST({column} AS {kind})"
            changes.append((name, _EXACT[kind], f"bool_or({differs})"))
        if kind == "DATE" or kind.startswith("TIMESTAMP"):
            iso = f"regexp_full_match(trim({column}), {quote(ISO_TIME)})"
            changes.append((name, "VARCHAR", f"bool_or(NOT {iso})"))
        if kind == "BIGINT":
            changes.append((name, "VARCHAR", f"bool_or(regexp_full_match({column}, '-?0\\d+'))"))
    as_text = {name: "VARCHAR" for name, _, _ in changes}
    source = Table((file,), tuple((kinds | as_text).items())).source
    values = ", ".join(condition for *_, condition in changes) or "1"
    # Where the file cannot be read, reading its rows says why.
    with contextlib.suppress(duckdb.Error):
        query = f"SELECT {values} FROM {source[:-1]}, ignore_errors = true)"
        (holding,) = connection.sql(query).fetchall()
        kinds |= {
            name: kind for (name, kind, _), holds in zip(changes, holding, strict=False) if holds
        }
    return tuple(kinds.items())


def first_line(error: Exception) -> str:
    """The first line of a message, cut off where it is long."""
    return f"{str(error).splitlines()[0]:.{_MAX_FAULT}}"


def fault_of_line(error: Exception) -> InputError | None:
    """Error that names the line of a CSV file which cannot be read; None for other errors."""
    fault, column = _CSV_FAULT.search(str(error)), _CSV_COLUMN.search(str(error))
    if fault is None:
        return None
    line, detail, file = fault.groups()
    detail = f"column {column[1]}: {column[2]}" if column else detail
    return InputError(
        f"{file}, line {line}: {detail:.{_MAX_FAULT}}; correct the line, or write the log as "
        "Parquet, where a column states its type"
    )
