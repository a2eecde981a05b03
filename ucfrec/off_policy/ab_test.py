"""The difference between two runs that shared the users: an A/B test on joined exposures."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, Float64Array
from ucfrec.errors import InputError, InputNote
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.engine import engine, explain_errors
from ucfrec.logs.join import FEEDBACK
from ucfrec.logs.mapping import log_files
from ucfrec.logs.tables import first_and_more, is_number, open_tables, quote_name
from ucfrec.off_policy.estimators import FEWEST_USERS, cluster_mean

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
    """Rows with a value, which count; what follows is left out."""
    without_value: tuple[int, int]
    """Rows of these arms without a value."""
    without_user: int
    without_arm: int
    """Rows of a user without an arm."""
    in_several: int
    """Users who were in more than one arm."""
    difference: float
    """Of the second arm less the first."""
    error: float
    """Its standard error, over users."""
    low: float | None
    """Ends of the 95% interval, for a test that ends when it was planned to; None, as the others,
    where an arm has fewer than `FEWEST_USERS` users or all are equal."""
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
        left_out = {
            f"rows have no {schema.USER_ID}; they are left out": self.without_user,
            f"rows have no {schema.ARM}; they are left out": self.without_arm,
            "users were in more than one arm; their rows are left out": self.in_several,
        }
        lines += [f"{count:,} {text}" for text, count in left_out.items() if count]
        low, high, always_low, always_high = (
            "unknown" if end is None else f"{end:+.4g}"
            for end in (self.low, self.high, self.always_low, self.always_high)
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
    N(0, expected²), fixed beforehand. With an estimated variance, above 0, it holds asymptotically
    (Waudby-Smith, Arbour, Sinha, Kennedy & Ramdas, Annals of Statistics 2024).
    """
    mixed = variance + expected**2
    inside = math.log(mixed / variance) - 2 * math.log(1 - LEVEL)
    radius = math.sqrt(variance * mixed / expected**2 * inside)
    return difference - radius, difference + radius


def compare_arms(
    paths: Sequence[str | Path],
    column: str = FEEDBACK,
    arms: Sequence[str] | None = None,
    expected: float | None = None,
    memory_limit: str = "2GB",
) -> Comparison:
    """Compare two arms, or the two that there are, most users first, in logs of `ucfrec join`.
    Users are drawn into arms, so they are clusters. Rows without a value are left out, with an
    `InputNote`. `expected` is the difference that the always-valid interval is tuned for, fixed
    beforehand; None for 5% of the first arm's value.

    Raises:
        InputError: a column is missing or no number, a value is infinite, or there are not two arms
            with two users each.
    """
    files = log_files(paths)
    name = first_and_more(files)
    groups = _sum_by_user(files, column, memory_limit)
    has_user, has_arm = groups["who"].astype(bool), groups[schema.ARM] != ""
    if beyond := int(groups["beyond"].sum()):
        raise InputError(
            f"{name}: {column} is infinite or beyond ±{_LARGEST:g} in {beyond:,} rows; correct the "
            "values, or remove them to leave the rows out"
        )
    counts = has_user & has_arm & (groups["arms"] == 1)
    sums: dict[str, Float64Array] = {}
    without_value: dict[str, int] = {}
    for arm in map(str, np.unique(groups[schema.ARM][counts])):
        inside = counts & (groups[schema.ARM] == arm)
        values, with_value, rows = (groups[part][inside] for part in ("value", "shown", "rows"))
        sums[arm] = np.stack([values, with_value.astype(np.float64)])[:, with_value > 0]
        without_value[arm] = int((rows - with_value).sum())
    users = {arm: values.shape[1] for arm, values in sums.items()}
    names = arms or sorted(users, key=lambda arm: -users[arm])
    if len(names) != 2 or min(users.get(arm, 0) for arm in names) < 2:
        present = ", ".join(f"{arm!r} ({count:,} users)" for arm, count in sorted(users.items()))
        raise InputError(
            f"{name}: two arms with two users each who have a value of {column} are needed, the "
            f"logs have {present or 'none'}; write exposures with serve --split, or name two with "
            "--arms A,B"
        )
    first, second = names
    if without_value[first] or without_value[second]:
        text = (
            f"{name}: {column} has no value in {without_value[first]:,} rows of {first} and "
            f"{without_value[second]:,} of {second}, which are left out; write 0 where it is meant"
        )
        warnings.warn(text, InputNote, stacklevel=2)
    (value_a, error_a), (value_b, error_b) = (
        cluster_mean(total / count, None, count) for total, count in (sums[first], sums[second])
    )
    difference, variance = value_b - value_a, error_b**2 + error_a**2
    error = math.sqrt(variance)
    low = high = always_low = always_high = None
    if min(error_a, error_b) > 0 and min(users[first], users[second]) >= FEWEST_USERS:
        mixture = expected or EXPECTED * abs(value_a) or error
        low, high = difference - _NORMAL * error, difference + _NORMAL * error
        always_low, always_high = always_valid(difference, variance, mixture)
    return Comparison(
        column=column,
        arms=(first, second),
        values=(value_a, value_b),
        users=(users[first], users[second]),
        rows=(int(sums[first][1].sum()), int(sums[second][1].sum())),
        without_value=(without_value[first], without_value[second]),
        without_user=int(groups["rows"][~has_user].sum()),
        without_arm=int(groups["rows"][has_user & ~has_arm].sum()),
        in_several=int((has_user & (groups["arms"] > 1) & groups["last"]).sum()),
        difference=difference,
        error=error,
        low=low,
        high=high,
        always_low=always_low,
        always_high=always_high,
    )


def _sum_by_user(files: Sequence[Path], column: str, memory_limit: str) -> dict[str, Array]:
    """Sum of the values, numbers of values and rows of each user in each arm; "" for no arm."""
    with (
        scratch_folder(Path(gettempdir()), "compare") as folder,
        engine(files, folder, memory_limit, shared=True) as connection,
    ):
        tables = tuple(open_tables(connection, files))
        for table in tables:
            kinds = table.columns
            numbers = [name for name, kind in kinds.items() if is_number(kind) or kind == "BOOLEAN"]
            missing = [name for name in (schema.USER_ID, schema.ARM, column) if name not in kinds]
            if missing or column not in numbers:
                fault = f" has no column {', '.join(missing)}"
                raise InputError(
                    f"{table.files[0]}{fault if missing else f': {column} is not a number'}; give "
                    f"the log of ucfrec join; its columns of numbers are {', '.join(numbers)}"
                )
        rows = " UNION ALL BY NAME ".join(
            f"SELECT nullif({table.text_of(schema.USER_ID)}, '') AS who, "
            f"nullif({table.text_of(schema.ARM)}, '') AS arm, "
            f"CAST({quote_name(column)} AS DOUBLE) AS value "
            f"FROM {table.with_texts([column], (schema.USER_ID, schema.ARM)).sql}"
            for table in tables
        )
        with explain_errors(connection, tables):
            groups: dict[str, Any] = connection.execute(
                "SELECT * REPLACE (who IS NOT NULL AS who, coalesce(arm, '') AS arm) FROM ("
                "SELECT who, arm, coalesce(sum(value), 0) AS value, "
                "count(value) AS shown, count(*) AS rows, "
                f"count(*) FILTER (abs(value) > {_LARGEST}) AS beyond, "
                "count(arm) OVER (PARTITION BY who) AS arms, "
                "coalesce(arm = max(arm) OVER (PARTITION BY who), false) AS last "
                f"FROM ({rows}) GROUP BY who, arm) AS groups ORDER BY groups.arm, groups.who"
            ).fetchnumpy()
    return groups | {schema.ARM: np.asarray(groups[schema.ARM], dtype=str)}
