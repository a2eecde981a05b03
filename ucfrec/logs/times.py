"""Times that a log has as text."""

import re
from calendar import month_name
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import duckdb

from ucfrec.errors import InputError
from ucfrec.logs.binding import explained
from ucfrec.logs.tables import ISO_TIME, Table, text

_DAY_OR_MONTH_FIRST: Final = r"(\d{1,2})[./-](\d{1,2})[./-](\d{4})((?:[T,]|\s).*)?"
_OF_DAY: Final = ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f", " %I:%M %p", " %I:%M:%S %p")


class _Survey(NamedTuple):
    """Of the text in a column of one file."""

    filled: int
    numbers: int
    iso: int
    """Times that begin with the year."""
    dated: int
    """Times that begin with the day or the month."""
    first: int | None
    """Largest of their first numbers."""
    second: int | None
    """Largest of their second numbers."""
    example: str | None
    """One of them."""
    strange: str | None
    """Text that is none of these."""


def text_time(
    connection: duckdb.DuckDBPyConnection,
    table: Table,
    sql: str,
    column: str,
    time_format: str | None,
) -> str:
    """SQL of the milliseconds since 1970 (UTC) that a column of text means, NULL where it is none.

    Args:
        column: name or expression of the column, for messages.
        time_format: of `strptime`, in which all times are written; None for numbers, ISO 8601, and
            dates whose order of day and month every file settles. Times without a zone are UTC.

    Raises:
        InputError: none of the text is a time, or the order of day and month is not settled.
    """
    if time_format is not None:
        return f"epoch_ms(TRY(CAST(try_strptime(trim({sql}), {text(time_format)}) AS TIMESTAMPTZ)))"
    with explained(connection, (table,), table.files[0].parent):
        surveys = [_survey(connection, replace(table, files=(f,)), sql) for f in table.files]
    numbers, iso = any(s.numbers for s in surveys), any(s.iso for s in surveys)
    dated = [(file, s) for file, s in zip(table.files, surveys, strict=True) if s.dated]
    where = f"{table.files[0]}: timestamp ({column})"
    if dated:
        if numbers or iso:
            raise InputError(
                f"{where} has times of several kinds; say how they are written with "
                "--time-format, or map an expression"
            )
        orders = {_order(file, survey) for file, survey in dated}
        if len(orders) > 1:
            raise InputError(
                f"{where} has the day first in some files and the month in others; prepare "
                "them apart, each with its --time-format"
            )
        return _date_time(sql, orders.pop())
    if not (numbers or iso) and any(s.filled for s in surveys):
        strange = min(s.strange for s in surveys if s.strange is not None)
        raise InputError(
            f"{where} is {strange!r:.60}, no ISO 8601 time nor milliseconds; say how it is "
            "written with --time-format, e.g. '%d %b %Y %H:%M'"
        )
    number = f"TRY_CAST(round(TRY_CAST({sql} AS DOUBLE)) AS BIGINT)"
    plain = f"replace(replace(replace(trim({sql}), '/', '-'), ',', '.'), 'UTC', 'Z')"
    # DuckDB reads no zone after a blank.
    plain = f"regexp_replace({plain}, '\\s+(Z|[+-]\\d{{2}}(:?\\d{{2}})?)$', '\\1')"
    time = f"TRY(epoch_ms(TRY_CAST({plain} AS TIMESTAMPTZ)::TIMESTAMP))"
    if not iso:
        return number
    return f"coalesce({time}, {number})" if numbers else time


def _survey(connection: duckdb.DuckDBPyConnection, table: Table, sql: str) -> _Survey:
    iso = f"regexp_full_match(x, {text(ISO_TIME)})"
    dated = f"regexp_full_match(x, {text(_DAY_OR_MONTH_FIRST)})"
    number = "TRY_CAST(x AS DOUBLE) IS NOT NULL"
    first, second = (
        f"TRY_CAST(regexp_extract(x, {text('^' + _DAY_OR_MONTH_FIRST + '$')}, {n}) AS INTEGER)"
        for n in (1, 2)
    )
    (row,) = connection.sql(
        f"SELECT count(x), count(*) FILTER ({number}), count(*) FILTER ({iso}), "
        f"count(*) FILTER ({dated}), "
        f"max({first}), max({second}), min(CASE WHEN {dated} THEN x END), "
        f"min(CASE WHEN NOT ({number} OR {iso} OR {dated}) THEN x END) "
        f"FROM (SELECT nullif(trim(CAST({sql} AS VARCHAR)), '') AS x FROM {table.sql})"
    ).fetchall()
    return _Survey._make(row)


def _order(file: Path, survey: _Survey) -> str:
    """How day and month follow each other in a file: "%d/%m" or "%m/%d"."""
    days = (survey.first or 0) > 12, (survey.second or 0) > 12
    if days[0] != days[1]:
        return "%d/%m" if days[0] else "%m/%d"
    where, example = f"{file}: timestamp is {survey.example!r:.40}", str(survey.example)
    if all(days):
        raise InputError(
            f"{where}, and neither day/month nor month/day reads every row; say how times are "
            "written with --time-format"
        )
    first, second = (int(number) for number in re.findall(r"\d+", example)[:2])
    sign = example.lstrip("0123456789")[:1]
    raise InputError(
        f"{where}: {first} {month_name[second]} or {second} {month_name[first]}? No row settles "
        f"it; add --time-format '%d{sign}%m{sign}%Y …' or '%m{sign}%d{sign}%Y …' with the time of "
        "day, e.g. %H:%M:%S"
    )


def _date_time(sql: str, order: str) -> str:
    """SQL of the milliseconds of dates with the day or the month first."""
    plain = (
        f"trim(regexp_replace(trim({sql}), {text('^' + _DAY_OR_MONTH_FIRST + '$')}, "
        r"'\1/\2/\3 \4'))"
    )
    # A comma or T before the time of day.
    plain = f"regexp_replace({plain}, '\\s+[T,]?\\s*', ' ')"
    formats = ", ".join(text(f"{order}/%Y{time}") for time in _OF_DAY)
    return f"epoch_ms(try_strptime({plain}, [{formats}]))"
