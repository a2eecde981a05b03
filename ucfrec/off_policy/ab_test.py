"""The difference between two runs that shared the users: an A/B test on joined exposures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import Final

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Float64Array
from ucfrec.errors import InputError
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.binding import explained
from ucfrec.logs.engine import engine
from ucfrec.logs.join import FEEDBACK
from ucfrec.logs.mapping import log_files
from ucfrec.logs.tables import is_number, open_tables, quoted
from ucfrec.off_policy.intervals import cluster_means

_NORMAL: Final = 1.959964
LEVEL: Final = 0.95
EXPECTED: Final = 0.05
"""Difference that the always-valid interval is tuned for, as a share of the first arm's value."""


@dataclass(frozen=True)
class Comparison:
    """Two arms of an A/B test, by the mean of a column per shown item."""

    column: str
    arms: tuple[str, str]
    values: tuple[float, float]
    users: tuple[int, int]
    rows: tuple[int, int]
    in_both: int
    """Users who were in both arms; their rows are left out."""
    difference: float
    """Of the second arm less the first."""
    error: float
    """Its standard error, over users."""
    low: float
    """Ends of the 95% interval, for a test that ends when it was planned to."""
    high: float
    always_low: float
    """Ends of the 95% interval that may be looked at as often as one likes, and acted upon."""
    always_high: float

    def __str__(self) -> str:
        lines = [
            f"{name}: {value:.4g} {self.column} per shown item; {users:,} users, {rows:,} items"
            for name, value, users, rows in zip(
                self.arms, self.values, self.users, self.rows, strict=True
            )
        ]
        if self.in_both:
            lines.append(f"{self.in_both:,} users were in both arms; their rows are left out")
        first, second = self.arms
        lines.append(
            f"{second} − {first}: {self.difference:+.4g} [{self.low:+.4g}, {self.high:+.4g}] at "
            f"a planned end; [{self.always_low:+.4g}, {self.always_high:+.4g}] always valid"
        )
        return "\n".join(lines)

    @property
    def conclusion(self) -> str:
        """What the always-valid interval says."""
        first, second = self.arms
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

    Raises:
        InputError: a column is missing or no number, or there are not two arms with two users each.
    """
    found, in_both = _by_user(paths, column, memory_limit)
    names = arms or tuple(sorted(found, key=lambda name: -len(found[name]))[:2])
    if len(names) != 2 or not all(len(found.get(name, ())) > 1 for name in names):
        there = ", ".join(map(repr, sorted(found))) or "none"
        raise InputError(
            f"two arms with two users each are needed, the logs have {there}; write exposures with "
            "serve --split, or name two with --arms"
        )
    if arms is None and len(found) > 2:
        raise InputError(f"the logs have {len(found)} arms; name two of them with --arms A,B")
    values, errors = zip(*(_mean(found[name]) for name in names), strict=True)
    difference, variance = values[1] - values[0], errors[0] ** 2 + errors[1] ** 2
    error = math.sqrt(variance)
    always = difference, difference
    if variance > 0:
        always = always_valid(difference, variance, expected or EXPECTED * abs(values[0]) or error)
    return Comparison(
        column,
        (names[0], names[1]),
        values,
        (len(found[names[0]]), len(found[names[1]])),
        (int(found[names[0]][:, 1].sum()), int(found[names[1]][:, 1].sum())),
        in_both,
        difference,
        error,
        difference - _NORMAL * error,
        difference + _NORMAL * error,
        *always,
    )


def _mean(rows: Float64Array) -> tuple[float, float]:
    """The mean per shown item and its standard error, from sums and counts (U, 2) of users."""
    counts = rows[:, 1:]
    means, errors = cluster_means(rows[:, :1] / counts, None, counts)
    return float(means[0]), float(errors[0])


def _by_user(
    paths: Sequence[str | Path], column: str, memory_limit: str
) -> tuple[dict[str, Float64Array], int]:
    """Sums of the column and numbers of rows (U, 2) of the users of each arm, by its name."""
    files = log_files(paths)
    with (
        scratch_folder(Path(gettempdir()), "compare") as folder,
        engine(files, folder, memory_limit, shared=True) as connection,
    ):
        tables = tuple(open_tables(connection, files))
        for table in tables:
            for name in (schema.USER_ID, schema.ARM, column):
                if name not in table.columns:
                    raise InputError(
                        f"{table.files[0]} has no column {name}; give the log of ucfrec join"
                    )
            if not is_number(table.columns[column]):
                raise InputError(f"{table.files[0]}: {column} is not a number; name another column")
        with explained(connection, tables, folder):
            rows = " UNION ALL BY NAME ".join(
                f"SELECT CAST({schema.USER_ID} AS VARCHAR) AS who, {schema.ARM} AS arm, "
                f"CAST({quoted(column)} AS DOUBLE) AS value FROM {table.sql}"
                for table in tables
            )
            connection.execute(
                "CREATE TABLE of_users AS SELECT who, arm, sum(value) AS value, count(*) AS shown, "
                f"count(*) OVER (PARTITION BY who) AS arms FROM ({rows}) WHERE arm != '' "
                "GROUP BY who, arm"
            )
            query = "SELECT arm, value, shown FROM of_users WHERE arms = 1 ORDER BY arm, who"
            kept = connection.sql(query).fetchnumpy()
            both = "SELECT count(DISTINCT who) FROM of_users WHERE arms > 1"
            ((in_both,),) = connection.sql(both).fetchall()
    names = np.asarray(kept[schema.ARM], dtype=str)
    pairs = np.stack([kept["value"], kept["shown"].astype(np.float64)], axis=1)
    return {str(name): pairs[names == name] for name in np.unique(names)}, int(in_both)
