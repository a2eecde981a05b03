"""Times that a log has as text."""

from dataclasses import dataclass, replace
from typing import Final

import duckdb

from ucfrec.errors import InputError
from ucfrec.logs.binding import explained
from ucfrec.logs.tables import ISO_TIME, Table, text

_DAY_OR_MONTH_FIRST: Final = r"(\d{1,2})[./-](\d{1,2})[./-](\d{4})((?:[T,]|\s).*)?"
_OF_DAY: Final = ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f", " %I:%M %p", " %I:%M:%S %p")
_MONTHS: Final = (
    *("January", "February", "March", "April", "May", "June"),
    *("July", "August", "September", "October", "November", "December"),
)


@dataclass(frozen=True)
class _Survey:
    """Of the text in a column."""

    filled: int
    numbers: int
    iso: int
    """Times that begin with the year."""
    other: int
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
    given: str,
    time_format: str | None,
) -> str:
    """SQL of the milliseconds since 1970 (UTC) that a column of text means, NULL where it is none.

    Args:
        given: name or expression of the column, for messages.
        time_format: of `strptime`, in which all times are written; None for numbers, ISO 8601, and
            dates whose order of day and month every file settles. Times without a zone are UTC.

    Raises:
        InputError: none of the text is a time, or the order of day and month is not settled.
    """
    if time_format is not None:
        return f"epoch_ms(TRY(CAST(try_strptime(trim({sql}), {text(time_format)}) AS TIMESTAMPTZ)))"
    with explained(connection, (table,), table.files[0].parent):
        found = _survey(connection, table, sql)
        where = f"{table.files[0]}: timestamp ({given})"
        if found.other:
            if found.numbers or found.iso:
                raise InputError(
                    f"{where} has times of several kinds; say how they are written with "
                    "--time-format, or map an expression"
                )
            orders = {_order(connection, table, sql, number) for number in range(len(table.files))}
            orders.discard("")
            if len(orders) > 1:
                raise InputError(
                    f"{where} has the day first in some files and the month in others; prepare "
                    "them apart, each with its --time-format"
                )
            return _ordered(sql, orders.pop())
    if found.filled and not (found.numbers or found.iso):
        raise InputError(
            f"{where} is {found.strange!r:.60}, no ISO 8601 time nor milliseconds; say how it is "
            "written with --time-format, e.g. '%d %b %Y %H:%M'"
        )
    number = f"TRY_CAST(round(TRY_CAST({sql} AS DOUBLE)) AS BIGINT)"
    plain = f"replace(replace(replace(trim({sql}), '/', '-'), ',', '.'), 'UTC', 'Z')"
    # DuckDB reads no zone after a blank.
    plain = f"regexp_replace({plain}, '\\s+(Z|[+-]\\d{{2}}(:?\\d{{2}})?)$', '\\1')"
    time = f"TRY(epoch_ms(TRY_CAST({plain} AS TIMESTAMPTZ)::TIMESTAMP))"
    if not found.iso:
        return number
    return f"coalesce({time}, {number})" if found.numbers else time


def _survey(connection: duckdb.DuckDBPyConnection, table: Table, sql: str) -> _Survey:
    iso = f"regexp_full_match(x, {text(ISO_TIME)})"
    other = f"regexp_full_match(x, {text(_DAY_OR_MONTH_FIRST)})"
    number = "TRY_CAST(x AS DOUBLE) IS NOT NULL"
    first, second = (
        f"TRY_CAST(regexp_extract(x, {text('^' + _DAY_OR_MONTH_FIRST + '$')}, {n}) AS INTEGER)"
        for n in (1, 2)
    )
    ((*counts,),) = connection.sql(
        f"SELECT count(x), count(*) FILTER ({number}), count(*) FILTER ({iso}), "
        f"count(*) FILTER ({other}), "
        f"max({first}), max({second}), min(CASE WHEN {other} THEN x END), "
        f"min(CASE WHEN NOT ({number} OR {iso} OR {other}) THEN x END) "
        f"FROM (SELECT nullif(trim(CAST({sql} AS VARCHAR)), '') AS x FROM {table.sql})"
    ).fetchall()
    return _Survey(*counts)


def _order(connection: duckdb.DuckDBPyConnection, table: Table, sql: str, number: int) -> str:
    """How day and month follow each other in a file: "%d/%m" or "%m/%d"; "" without such times."""
    one = replace(table, files=(table.files[number],))
    found = _survey(connection, one, sql)
    if not found.other:
        return ""
    days = [(found.first or 0) > 12, (found.second or 0) > 12]
    if days == [True, False]:
        return "%d/%m"
    if days == [False, True]:
        return "%m/%d"
    where = f"{one.files[0]}: timestamp is {found.example!r:.40}"
    if all(days):
        raise InputError(
            f"{where}, and neither day/month nor month/day reads every row; say how times are "
            "written with --time-format"
        )
    first, second = (int(each) for each in _numbers(str(found.example)))
    sign = str(found.example).lstrip("0123456789")[:1]
    raise InputError(
        f"{where}: {first} {_MONTHS[second - 1]} or {second} {_MONTHS[first - 1]}? No row settles "
        f"it; add --time-format '%d{sign}%m{sign}%Y …' or '%m{sign}%d{sign}%Y …' with the time of "
        "day, e.g. %H:%M:%S"
    )


def _numbers(example: str) -> list[str]:
    return "".join(each if each.isdecimal() else " " for each in example).split()[:2]


def _ordered(sql: str, order: str) -> str:
    plain = (
        f"trim(regexp_replace(trim({sql}), {text('^' + _DAY_OR_MONTH_FIRST + '$')}, "
        r"'\1/\2/\3 \4'))"
    )
    # A comma or T before the time of day.
    plain = f"regexp_replace({plain}, '\\s+[T,]?\\s*', ' ')"
    formats = ", ".join(text(f"{order}/%Y{time}") for time in _OF_DAY)
    return f"epoch_ms(try_strptime({plain}, [{formats}]))"
