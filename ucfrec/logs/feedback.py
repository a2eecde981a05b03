"""Which columns of the files are feedback, and which seem to be meant as such but are text."""

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import duckdb

from ucfrec.errors import InputError, InputNote
from ucfrec.logs.tables import PANDAS_INDEX, Table, first_and_more, is_number, quoted, text

_NUMBER_LIKE: Final = r"[-+]?[$€£]?(\d+|\d{1,3}([., ']\d{3})+)([.,]\d+)?\s*[%$€£]?"
"""Text that means a number, though it may not be written as one."""
_TRUTH_LIKE: Final = "('true', 'false', 'yes', 'no')"
_WRITE_NUMBERS: Final = (
    "write numbers as 12.50, truth values as true and false, and nothing where there is none"
)


def names_of(table: Table) -> dict[str, str]:
    """Column names in lower case to those of the files, without a pandas index: case does not
    matter."""
    return {name.casefold(): name for name in table.columns if not PANDAS_INDEX.fullmatch(name)}


def holds_feedback(kind: str) -> bool:
    """Whether a DuckDB type is one of feedback: numbers or truth values."""
    return is_number(kind) or kind == "BOOLEAN"


def feedback_columns(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[Table],
    used: Collection[str],
    own: str,
    shown: Collection[str],
) -> tuple[str, ...]:
    """Columns of numbers and truth values, each once, with a note on others that may be meant.

    Args:
        used: names in lower case that are none of feedback.
        own: the one that the log has itself, too.
        shown: those of `used` that the log has of the exposures.

    Raises:
        InputError: a column has numbers in one file, and something else in another.
    """
    columns: dict[str, tuple[str, Table]] = {}
    left_out: dict[str, str] = {}
    for table in tables:
        for key, name in names_of(table).items():
            if key not in used and holds_feedback(table.columns[name]):
                columns.setdefault(key, (name, table))
    for table in tables:
        others = []
        for key, name in names_of(table).items():
            kind = table.columns[name]
            if key in shown:
                left_out[name] = "of the exposures, too"
            elif key == own and holds_feedback(kind):
                _note_left_out(table, name, "the log has its own, the number of rows; rename it")
            elif (
                not holds_feedback(kind)
                and key not in used
                and (key in columns or kind == "VARCHAR")
            ):
                others.append(name)
        for words in _Words.of(connection, table, others):
            if words.name.casefold() in columns:
                _require_numbers(words, columns[words.name.casefold()][1])
            elif words.mean_numbers:
                _note_left_out(table, words.name, f"it is text, {words}; {_WRITE_NUMBERS}")
            elif words.values:
                left_out[words.name] = "text"
    if left_out:
        named = ", ".join(f"{name} ({why})" for name, why in left_out.items())
        files = first_and_more([file for table in tables for file in table.files])
        warnings.warn(
            f"{files}: columns are left out: {named}; where one is feedback, write it as numbers "
            "or truth values, in a column of its own name",
            InputNote,
            stacklevel=4,
        )
    return tuple(name for name, _ in columns.values())


def _note_left_out(table: Table, name: str, why: str) -> None:
    files = first_and_more(table.files)
    warnings.warn(f"{files}: column {name} is left out: {why}", InputNote, stacklevel=5)


@dataclass(frozen=True)
class _Words:
    """What a column that does not hold numbers holds instead."""

    table: Table
    name: str
    values: int
    """That are not missing."""
    others: int
    """Of these, the ones that are not numbers."""
    alike: int
    """Values that are numbers or truth values, or seem to mean one."""
    sample: str | None
    """A value that is not a number, preferably one that does not seem to mean one either."""
    one_word: bool
    """Whether all values that do not seem to mean a number are the same, such as n/a."""

    @classmethod
    def of(
        cls, connection: duckdb.DuckDBPyConnection, table: Table, names: Sequence[str]
    ) -> "list[_Words]":
        """Those of each of some columns, read at once."""
        if not names:
            return []
        columns = [f"trim(CAST({quoted(name)} AS VARCHAR)) AS x{n}" for n, name in enumerate(names)]
        asked = []
        for n in range(len(names)):
            number = f"coalesce(isfinite(TRY_CAST(x{n} AS DOUBLE)), false)"
            alike = f"({number} OR regexp_full_match(x{n}, {text(_NUMBER_LIKE)}) "
            alike += f"OR lower(x{n}) IN {_TRUTH_LIKE})"
            least, most = (f"{each}(x{n}) FILTER (NOT {alike})" for each in ("min", "max"))
            asked.append(
                f"[count(x{n}), count(x{n}) FILTER (NOT {number}), count(*) FILTER ({alike})], "
                f"coalesce({least}, min(x{n}) FILTER (NOT {number})), "
                f"coalesce({least} = {most}, false)"
            )
        (row,) = connection.sql(
            f"SELECT {', '.join(asked)} FROM "
            f"(SELECT {', '.join(columns)} FROM {table.of(names).sql})"
        ).fetchall()
        found = zip(names, row[::3], row[1::3], row[2::3], strict=True)
        return [cls(table, name, *counts, *more) for name, counts, *more in found]

    @property
    def mean_numbers(self) -> bool:
        """Whether the column seems to be one of feedback: half of it, or all but one word."""
        return self.alike > 0 and (2 * self.alike >= self.values or self.one_word)

    def __str__(self) -> str:
        if not self.others:
            return f"though all {self.values:,} are numbers"
        return f"{self.others:,} of {self.values:,} are not numbers (such as {self.sample!r:.60})"


def _require_numbers(words: _Words, numbers: Table) -> None:
    """Refuse a column that has numbers in other files only: its values would count as 0."""
    if words.others:
        raise InputError(
            f"{words.table.files[0]}: column {words.name} has numbers in {numbers.files[0]}, but "
            f"here {words}; {_WRITE_NUMBERS}; or remove the column"
        )
