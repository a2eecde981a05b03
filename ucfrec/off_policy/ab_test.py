"""The difference between two runs that shared the users: an A/B test on joined exposures."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import gettempdir
from typing import Final

import duckdb
import numpy as np

from ucfrec import schema
from ucfrec.arrays import Float64Array
from ucfrec.errors import InputError, InputNote
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.binding import explained
from ucfrec.logs.engine import engine
from ucfrec.logs.join import FEEDBACK
from ucfrec.logs.mapping import log_files
from ucfrec.logs.tables import Table, first_and_more, is_number, open_tables, quoted
from ucfrec.off_policy.intervals import FEWEST_USERS, cluster_mean

_NORMAL: Final = 1.959964
LEVEL: Final = 0.95
EXPECTED: Final = 0.05
"""Difference that the always-valid interval is tuned for, as a share of the first arm's value."""
_LARGEST: Final = 1e100
"""Values beyond are refused, as infinite ones are: their squares would not be finite."""


@dataclass(frozen=True)
class Comparison:
    """Two arms of an A/B test, by the mean of a column per shown item."""

    column: str
    arms: tuple[str, str]
    values: tuple[float, float]
    users: tuple[int, int]
    rows: tuple[int, int]
    """Rows with a value, which count."""
    without_value: tuple[int, int]
    """Rows of these arms without a value, which are left out."""
    without_user: int
    """Rows without a user, which are left out."""
    without_arm: int
    """Rows of a user without an arm, which are left out."""
    in_several: int
    """Users who were in more than one arm; their rows are left out."""
    difference: float
    """Of the second arm less the first."""
    error: float
    """Its standard error, over users."""
    low: float | None
    """Ends of the 95% interval, for a test that ends when it was planned to; None, as the others,
    where an arm has fewer than `FEWEST_USERS` users or no user differs from another of the arm."""
    high: float | None
    always_low: float | None
    """Ends of the 95% interval that may be looked at as often as one likes, and acted upon."""
    always_high: float | None

    def __str__(self) -> str:
        lines = [
            f"{name}: {value:.4g} {self.column} per shown item; {users:,} users, {rows:,} items"
            for name, value, users, rows in zip(
                self.arms, self.values, self.users, self.rows, strict=True
            )
        ]
        for lacking, name in ((self.without_user, schema.USER_ID), (self.without_arm, schema.ARM)):
            if lacking:
                lines.append(f"{lacking:,} rows have no {name}; they are left out")
        if self.in_several:
            lines.append(
                f"{self.in_several:,} users were in more than one arm; their rows are left out"
            )
        ends = self.low, self.high, self.always_low, self.always_high
        low, high, always_low, always_high = (
            "unknown" if end is None else f"{end:+.4g}" for end in ends
        )
        lines.append(
            f"{' − '.join(reversed(self.arms))}: {self.difference:+.4g} [{low}, {high}] at a "
            f"planned end; [{always_low}, {always_high}] always valid"
        )
        return "\n".join(lines)

    @property
    def conclusion(self) -> str:
        """What the always-valid interval says."""
        first, second = self.arms
        if self.always_low is None or self.always_high is None:
            return (
                f"nothing can be said yet: an arm has fewer than {FEWEST_USERS} users with a "
                f"value, or {self.column} is the same for all users of an arm"
            )
        if self.always_low > 0:
            return f"{second} is better than {first}"
        if self.always_high < 0:
            return f"{second} is worse than {first}"
        return f"no difference between {first} and {second} is shown so far"


def always_valid(difference: float, variance: float, expected: float) -> tuple[float, float]:
    """A confidence sequence: with a probability of 95%, it holds the true difference at all times.

    The mixture sequential probability ratio test for normal estimates, inverted (Johari, Koomen,
    Pekelis & Walsh, Always valid inference, Operations Research 2022): the difference is mixed over
    N(0, expected²). With an estimated variance it holds asymptotically (Waudby-Smith, Arbour,
    Sinha, Kennedy & Ramdas, Annals of Statistics 2024).

    Args:
        variance: of the estimate so far, above 0.
        expected: standard deviation τ of the mixture, fixed beforehand: near the differences that
            matter, the interval is shortest.
    """
    mixed = variance + expected**2
    inside = math.log(mixed / variance) - 2 * math.log(1 - LEVEL)
    radius = math.sqrt(variance * mixed / expected**2 * inside)
    return difference - radius, difference + radius


def compare_arms(
    paths: Sequence[str | Path],
    column: str = FEEDBACK,
    arms: tuple[str, str] | None = None,
    expected: float | None = None,
    memory_limit: str = "2GB",
) -> Comparison:
    """Compare two arms in logs of `ucfrec join`. Users are drawn into arms, so they are clusters.

    Args:
        paths: logs, with the column `arm`.
        arms: names of the first arm and the other; None for the two that there are, the one with
            more users first.
        expected: difference that the always-valid interval is tuned for, fixed beforehand; None for
            5% of the first arm's value.

    An `InputNote` says how many rows have no value in the column; they are left out.

    Raises:
        InputError: a column is missing or no number, a value is infinite, or there are not two arms
            with two users each.
    """
    log = _by_user(paths, column, memory_limit)
    found = log.of_arms
    names = arms or tuple(sorted(found, key=lambda name: -len(found[name]))[:2])
    if len(names) != 2 or not all(len(found.get(name, ())) > 1 for name in names):
        there = ", ".join(f"{name!r} ({len(found[name]):,} users)" for name in sorted(found))
        raise InputError(
            f"{log.name}: two arms with two users each who have a value of {column} are needed, "
            f"the logs have {there or 'none'}; write exposures with serve --split, or name two "
            "with --arms"
        )
    if arms is None and len(found) > 2:
        raise InputError(f"the logs have {len(found)} arms; name two of them with --arms A,B")
    first, second = names
    lacking = log.without_value[first], log.without_value[second]
    if any(lacking):
        warnings.warn(
            f"{log.name}: {column} has no value in {lacking[0]:,} rows of {first} and "
            f"{lacking[1]:,} of {second}, which are left out; write 0 where that is meant",
            InputNote,
            stacklevel=2,
        )
    counts = [found[name].T for name in names]
    values, errors = zip(*(cluster_mean(s / n, None, n) for s, n in counts), strict=True)
    difference, variance = values[1] - values[0], errors[0] ** 2 + errors[1] ** 2
    error = math.sqrt(variance)
    ends: tuple[float | None, ...] = (None,) * 4
    if min(errors) > 0 and min(len(found[name]) for name in names) >= FEWEST_USERS:
        always = always_valid(difference, variance, expected or EXPECTED * abs(values[0]) or error)
        ends = difference - _NORMAL * error, difference + _NORMAL * error, *always
    return Comparison(
        column,
        (first, second),
        values,
        (len(found[first]), len(found[second])),
        (int(found[first][:, 1].sum()), int(found[second][:, 1].sum())),
        lacking,
        log.without_user,
        log.without_arm,
        log.in_several,
        difference,
        error,
        *ends,
    )


@dataclass(frozen=True)
class _Log:
    """What the logs have of a column."""

    name: str
    """The first file, and how many more there are."""
    of_arms: dict[str, Float64Array]
    """(U, 2) sums of the values and their number, of the users of each arm who have one."""
    without_value: dict[str, int]
    without_user: int
    without_arm: int
    in_several: int


def _by_user(paths: Sequence[str | Path], column: str, memory_limit: str) -> _Log:
    files = log_files(paths)
    with (
        scratch_folder(Path(gettempdir()), "compare") as folder,
        engine(files, folder, memory_limit, shared=True) as connection,
    ):
        tables = tuple(open_tables(connection, files))
        for table in tables:
            _require_columns(table, column)
        with explained(connection, tables, folder):
            connection.execute(
                "CREATE TABLE of_users AS SELECT who, arm, coalesce(sum(value), 0) AS value, "
                "count(value) AS shown, count(*) AS rows, "
                f"count(*) FILTER (abs(value) > {_LARGEST}) AS beyond, "
                "count(arm) OVER (PARTITION BY who) AS arms "
                f"FROM ({_rows(tables, column)}) GROUP BY who, arm"
            )
            kept = connection.sql(
                "SELECT arm, value, shown, rows FROM of_users "
                "WHERE who IS NOT NULL AND arm IS NOT NULL AND arms = 1 ORDER BY arm, who"
            ).fetchnumpy()
            ((in_several, nobody, no_arm, beyond),) = connection.sql(
                "SELECT count(DISTINCT who) FILTER (arms > 1), "
                "coalesce(sum(rows) FILTER (who IS NULL), 0), "
                "coalesce(sum(rows) FILTER (who IS NOT NULL AND arm IS NULL), 0), "
                "coalesce(sum(beyond), 0) FROM of_users"
            ).fetchall()
            if beyond:
                raise _beyond(connection, tables, column)
    names, shown = np.asarray(kept[schema.ARM], dtype=str), kept["shown"]
    pairs = np.stack([kept["value"], shown.astype(np.float64)], axis=1)
    arms = [str(name) for name in np.unique(names)]
    return _Log(
        first_and_more(files),
        {name: pairs[(names == name) & (shown > 0)] for name in arms},
        {name: int((kept["rows"] - shown)[names == name].sum()) for name in arms},
        int(nobody),
        int(no_arm),
        int(in_several),
    )


def _require_columns(table: Table, column: str) -> None:
    file, kinds = table.files[0], table.columns
    for name in (schema.USER_ID, schema.ARM):
        if name not in kinds:
            raise InputError(f"{file} has no column {name}; give the log of ucfrec join")
    numbers = [name for name, kind in kinds.items() if is_number(kind) or kind == "BOOLEAN"]
    if column not in numbers:
        lacks = f": {column} is not a number" if column in kinds else f" has no column {column}"
        remedy = f"its columns of numbers are {', '.join(numbers)}"
        raise InputError(f"{file}{lacks}; {remedy if numbers else 'give the log of ucfrec join'}")


def _rows(tables: Sequence[Table], column: str) -> str:
    """SQL of the rows: `who`, `arm` and `value`, NULL where there is none."""
    return " UNION ALL BY NAME ".join(
        f"SELECT nullif({table.text_of(schema.USER_ID)}, '') AS who, "
        f"nullif({table.text_of(schema.ARM)}, '') AS arm, "
        f"CAST({quoted(column)} AS DOUBLE) AS value FROM {read.sql}"
        for table in tables
        for read in [table.with_texts([column], (schema.USER_ID, schema.ARM))]
    )


def _beyond(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[Table], column: str
) -> InputError:
    """Error for infinite values: names the file with the most."""
    counts = {}
    for single in [replace(table, files=(file,)) for table in tables for file in table.files]:
        query = f"SELECT count(*) FILTER (abs(value) > {_LARGEST}) FROM ({_rows([single], column)})"
        ((counts[single.files[0]],),) = connection.sql(query).fetchall()
    file = max(counts, key=lambda each: counts[each])
    return InputError(
        f"{file}: {column} is infinite or beyond ±{_LARGEST:g} in {counts[file]:,} rows; correct "
        "the values, or remove them to leave the rows out"
    )
