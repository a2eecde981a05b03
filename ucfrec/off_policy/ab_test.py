"""The difference between two runs that shared the users: an A/B test on joined exposures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import NormalDist
from tempfile import gettempdir
from typing import Literal, get_args

import pandas as pd

from ucfrec import schema
from ucfrec.errors import InputError, warn_user
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.engine import bind, engine, explain_errors, wrong_type
from ucfrec.logs.join import FEEDBACK
from ucfrec.logs.mapping import log_files
from ucfrec.logs.tables import first_and_more, is_number, open_tables
from ucfrec.off_policy.estimators import FEWEST_USERS, cluster_mean
from ucfrec.off_policy.guardrails import GroupDifference, Guardrail
from ucfrec.results.evidence import Evidence
from ucfrec.settings import require

MISS = 0.05
"""Probability with which an interval misses the difference."""
EXPECTED = 0.05
"""Difference that the always-valid interval is tuned for, as a share of the first arm's value."""
MISMATCH = 0.001
"""Below this p-value, the users were not drawn into the arms by the intended shares."""
_LARGEST = 1e100
"""Values beyond are refused, as infinite ones are: their squares would not be finite."""
Per = Literal["session", "item"]
_LONGEST = 1e9
_NAMED = 3
"""Most users of several arms that are named."""


@dataclass(frozen=True)
class Comparison:
    """Two arms of an A/B test, by the mean of a column per session or per shown item."""

    column: str
    per: Per
    arms: tuple[str, str]
    values: tuple[float, float]
    users: tuple[int, int]
    """Users with a value."""
    in_arm: tuple[int, int]
    """All users of the arms."""
    shares: tuple[float, float]
    """Intended shares of the arms among the users of both."""
    units: tuple[int, int]
    """Sessions or shown items with a value, which count; what follows is left out."""
    without_value: tuple[int, int]
    """Rows of these arms without a value."""
    without_user: int
    without_arm: int
    """Rows of a user without an arm."""
    in_several: int
    """Users who were in more than one arm."""
    several_names: tuple[str, ...]
    """Some of them."""
    planned: Evidence
    """Of the second arm less the first, for a test that ends when it was planned to."""
    always: Evidence
    """The same, with an interval that may be looked at as often as one likes, and acted upon."""
    guardrails: tuple[Guardrail, ...] = ()
    """Always valid."""
    groups: tuple[GroupDifference, ...] = ()
    """Always valid, and for all groups at once."""

    def __str__(self) -> str:
        lines = [self.conclusion]
        lines += [
            f"{name}: {value:.4g} {self.column} per {self.per}; {users:,} users, "
            f"{units:,} {self.per}s"
            for name, value, users, units in zip(
                self.arms, self.values, self.users, self.units, strict=True
            )
        ]
        names = ", ".join(self.several_names) + ", …" * (self.in_several > len(self.several_names))
        left_out = {
            f"rows have no {schema.USER_ID}; they are left out": self.without_user,
            f"rows have no {schema.ARM}; they are left out": self.without_arm,
            f"users were in more than one arm ({names}); their rows are left out": self.in_several,
        }
        lines += [f"{count:,} {text}" for text, count in left_out.items() if count]
        lines.append(
            f"{' − '.join(reversed(self.arms))}: {self.planned.format('+.4g')} at a planned end; "
            f"{self.always.format('+.4g')} always valid"
        )
        return "\n".join([*lines, *map(str, self.guardrails), *map(str, self.groups)])

    @property
    def conclusion(self) -> str:
        """What the split of the users, the always-valid interval and the guardrails say."""
        first, second = self.arms
        if self.always.reasons:
            return f"nothing can be concluded: {self.always.reasons[0]}"
        standing = self.always.standing()
        if standing not in ("better", "worse"):
            return f"no difference between {first} and {second} is shown so far"
        says = f"{second} is {standing} than {first}"
        outcomes = {guardrail.outcome for guardrail in self.guardrails} - {"holds"}
        if not outcomes or standing == "worse":
            return says
        return f"{says}, but a guardrail is {'broken' if 'broken' in outcomes else 'open'}"


def always_valid(
    difference: float, variance: float, expected: float, miss: float = MISS
) -> tuple[float, float]:
    """A confidence sequence: but for a probability of `miss`, it holds the true difference at all
    times.

    The mixture sequential probability ratio test for normal estimates, inverted (Johari, Koomen,
    Pekelis & Walsh, Always valid inference, Operations Research 2022): the difference is mixed over
    N(0, expected²), fixed beforehand. With an estimated variance, above 0, it holds asymptotically
    (Waudby-Smith, Arbour, Sinha, Kennedy & Ramdas, Annals of Statistics 2024).
    """
    mixed = variance + expected**2
    inside = math.log(mixed / variance) - 2 * math.log(miss)
    radius = math.sqrt(variance * mixed / expected**2 * inside)
    return difference - radius, difference + radius


@dataclass(frozen=True)
class _Means:
    """The means of a measure per unit in two arms, with their errors over users."""

    values: tuple[float, float]
    errors: tuple[float, float]
    users: tuple[int, int]
    units: tuple[int, int]

    @classmethod
    def of(cls, arms: Sequence[pd.DataFrame]) -> "_Means":
        """Of the users with a value in two arms."""
        (value_a, error_a), (value_b, error_b) = (
            cluster_mean((arm["value"] / arm["units"]).to_numpy(), None, arm["units"].to_numpy())
            for arm in arms
        )
        units_a, units_b = (int(arm["units"].sum()) for arm in arms)
        users = len(arms[0]), len(arms[1])
        return cls((value_a, value_b), (error_a, error_b), users, (units_a, units_b))

    def list_faults(self) -> tuple[str, ...]:
        """Why there is no interval."""
        if min(self.users) < FEWEST_USERS:
            return (f"an arm has fewer than {FEWEST_USERS} users with a value",)
        return () if min(self.errors) > 0 else ("all users of an arm have the same value",)

    def compare(
        self, expected: float | None, reasons: Sequence[str] = (), miss: float = MISS
    ) -> tuple[Evidence, Evidence]:
        """The difference at a planned end, and always valid."""
        value, variance = self.values[1] - self.values[0], sum(e**2 for e in self.errors)
        if faults := (*reasons, *self.list_faults()):
            unknown = Evidence(value, None, None, faults)
            return unknown, unknown
        error = math.sqrt(variance)
        half = NormalDist().inv_cdf(1 - miss / 2) * error
        mixture = expected or EXPECTED * abs(self.values[0]) or error
        low, high = always_valid(value, variance, mixture, miss)
        return Evidence(value, value - half, value + half), Evidence(value, low, high)

    def check(self, guardrail: Guardrail, reasons: Sequence[str]) -> Guardrail:
        """The change of the second arm, as a share of the first."""
        (a, b), (error_a, error_b) = self.values, self.errors
        faults = (*reasons, *self.list_faults(), *(["its mean is not above 0"] if a <= 0 else []))
        if faults:
            return replace(guardrail, change=Evidence(None, None, None, faults))
        variance = (error_b / a) ** 2 + (b * error_a / a**2) ** 2
        low, high = always_valid(b / a - 1, variance, EXPECTED)
        return replace(guardrail, change=Evidence(b / a - 1, low, high))


def compare_arms(
    paths: Sequence[str | Path],
    column: str = FEEDBACK,
    arms: Sequence[str] | None = None,
    expected: float | None = None,
    shares: Mapping[str, float] | None = None,
    memory_limit: str = "2GB",
    guardrails: Sequence[str] = (),
    by: str | None = None,
    per: Per = "session",
    gap_minutes: float = 30.0,
) -> Comparison:
    """Compare two arms, or the two that there are, most users first, in logs of `ucfrec join`, by
    the sum of a column `per` session, which a longer pause than `gap_minutes` ends, or per shown
    item. Users are drawn into arms, so they are clusters. Rows without a value are left out, with
    an `InputNote`. `expected` is the difference that the always-valid interval is tuned for, fixed
    beforehand; None for 5% of the first arm's value. `shares` of the users were intended for the
    arms, by name; None for equal ones. `guardrails` are as `dwell_seconds >= -2%`; `by` is a column
    or expression to show the difference by. InputError if a column is missing or no number, a value
    is infinite, or there are not two arms with two users each."""
    fault = f"expected is {expected}; give a difference above 0, and below {_LARGEST:g}"
    require(expected is None or 1 / _LARGEST < expected < _LARGEST, fault)
    require(per in get_args(Per), f"per is {per!r}; give 'session' or 'item'")
    fault = f"gap_minutes is {gap_minutes}; give minutes above 0, and below {_LONGEST:g}"
    require(0 < gap_minutes < _LONGEST, fault)
    files = log_files(paths)
    name = first_and_more(files)
    sum_up = partial(_sum_by_user, files, memory_limit, gap_minutes if per == "session" else None)
    groups = sum_up(column)
    by_arm, valued = _split_arms(groups)
    names = arms or sorted(valued, key=lambda arm: -len(valued[arm]))
    if len({*names}) != 2 or min(len(valued.get(arm, ())) for arm in names) < 2:
        present = ", ".join(f"{arm!r} ({len(rows):,} users)" for arm, rows in valued.items())
        raise InputError(
            f"{name}: two arms with two users each who have a value of {column} are needed, the "
            f"logs have {present or 'none'}; write exposures with serve --split, or name two with "
            "--arms A,B"
        )
    first, second = names
    if shares is not None and not all(shares.get(arm, 0) > 0 for arm in names):
        raise InputError(f"{name}: shares are {shares}; give one above 0 to each arm of {names}")
    of_first, of_second = (1.0 if shares is None else shares[arm] for arm in names)
    share, in_arm = of_first / (of_first + of_second), (len(by_arm[first]), len(by_arm[second]))
    means = _Means.of([valued[arm] for arm in names])
    without_value = _count_missing(name, column, names, by_arm)
    reasons = _doubt_split(in_arm, share)
    planned, always = means.compare(expected, reasons)
    results = []
    for guardrail in map(Guardrail.parse, guardrails):
        all_rows, values = _split_arms(sum_up(guardrail.measure))
        if not all(len(values.get(arm, ())) for arm in names):
            raise InputError(f"{name}: an arm has no value of {guardrail.measure}")
        _count_missing(name, guardrail.measure, names, all_rows)
        results.append(_Means.of([values[arm] for arm in names]).check(guardrail, reasons))
    differences: list[GroupDifference] = []
    if by is not None:
        differences = _compare_parts(sum_up(column, by), names, expected, reasons)
    mixed = groups["name"].dropna().unique()
    return Comparison(
        column=column,
        per=per,
        arms=(first, second),
        values=means.values,
        users=means.users,
        in_arm=in_arm,
        shares=(share, 1 - share),
        units=means.units,
        without_value=without_value,
        without_user=int(groups["rows"][~groups["who"]].sum()),
        without_arm=int(groups["rows"][groups["who"] & (groups[schema.ARM] == "")].sum()),
        in_several=len(mixed),
        several_names=tuple(sorted(mixed)[:_NAMED]),
        planned=planned,
        always=always,
        guardrails=tuple(results),
        groups=tuple(differences),
    )


def _count_missing(
    name: str, measure: str, arms: Sequence[str], by_arm: Mapping[str, pd.DataFrame]
) -> tuple[int, int]:
    """Rows of two arms without a value, which a note tells of."""
    first, second = (int((by_arm[arm]["rows"] - by_arm[arm]["shown"]).sum()) for arm in arms)
    if first or second:
        warn_user(
            f"{name}: {measure} has no value in {first:,} rows of {arms[0]} and {second:,} of "
            f"{arms[1]}, which are left out; write 0 where it is meant"
        )
    return first, second


def _compare_parts(
    groups: pd.DataFrame, arms: Sequence[str], expected: float | None, reasons: Sequence[str]
) -> list[GroupDifference]:
    """The differences in the parts of the rows, with always-valid intervals that hold at once."""
    parts, differences = list(groups.groupby("part")), []
    for part, rows in parts:
        values = _split_arms(rows)[1]
        if all(len(values.get(arm, ())) for arm in arms):
            means = _Means.of([values[arm] for arm in arms])
            evidence = means.compare(expected, reasons, MISS / len(parts))[1]
            differences.append(GroupDifference(str(part), sum(means.users), evidence))
    return differences


def _doubt_split(users: tuple[int, int], share: float) -> list[str]:
    """Why a difference may be one of the users (Fabijan et al., KDD 2019), if it may."""
    from scipy.stats import chisquare  # takes a moment to import

    total = sum(users)
    p_value = float(chisquare(users, [total * share, total * (1 - share)]).pvalue)
    if p_value >= MISMATCH:
        return []
    return [
        f"sample ratio mismatch: {users[0]:,} and {users[1]:,} users, {users[0] / total:.1%} and "
        f"{users[1] / total:.1%}, where {share:.1%} and {1 - share:.1%} were intended (p = "
        f"{p_value:.2g}): users are missing from an arm, or name the shares that were intended: "
        "--shares A=0.9,B=0.1"
    ]


def _split_arms(groups: pd.DataFrame) -> tuple[dict[str, pd.DataFrame], dict[str, pd.DataFrame]]:
    """The users of each arm, and those with a value; without those of several arms."""
    counts = groups["who"] & (groups[schema.ARM] != "") & ~groups["mixed"]
    by_arm = {str(arm): rows for arm, rows in groups[counts].groupby(schema.ARM)}
    return by_arm, {arm: rows[rows["shown"] > 0] for arm, rows in by_arm.items()}


def _sum_by_user(
    files: Sequence[Path],
    memory_limit: str,
    gap_minutes: float | None,
    measure: str,
    by: str | None = None,
) -> pd.DataFrame:
    """Sum of the values, numbers of values, rows and units of each user in each arm and part, ""
    for none; and the names of users of several arms. Units are sessions, or values without a gap.
    InputError if a column is missing, `measure` is no number, or a value is infinite."""
    with (
        scratch_folder(Path(gettempdir()), "compare") as folder,
        engine(files, folder, memory_limit) as connection,
    ):
        tables, selects = tuple(open_tables(connection, files)), []
        for table in tables:
            value = bind(connection, table, "a measure", measure)
            if not (is_number(value.kind) or value.kind == "BOOLEAN"):
                remedy = "name a column of numbers of the log of ucfrec join"
                raise wrong_type(table, "what is compared", measure, value.kind, remedy)
            ids = [
                table.text_of(bind(connection, table, what, name).columns[0])
                for what, name in (("users", schema.USER_ID), ("arms of join", schema.ARM))
            ]
            part = bind(connection, table, "--by", by) if by is not None else None
            columns, time = [*value.columns, *(part.columns if part else ())], "NULL"
            if gap_minutes is not None:
                times = bind(connection, table, "sessions, or give per item", schema.TIMESTAMP)
                if not is_number(times.kind):
                    remedy = "convert it to milliseconds, as join writes it, or compare per item"
                    raise wrong_type(table, "times", schema.TIMESTAMP, times.kind, remedy)
                columns, time = [*columns, *times.columns], times.sql
            selects.append(
                f"SELECT nullif({ids[0]}, '') AS who, nullif({ids[1]}, '') AS arm, "
                f"CAST({value.sql} AS DOUBLE) AS value, CAST({time} AS DOUBLE) AS time, "
                f"{f'CAST({part.sql} AS VARCHAR)' if part else 'NULL'} AS part "
                f"FROM {table.add_texts(columns, (schema.USER_ID, schema.ARM)).sql}"
            )
        begins = "true"
        if gap_minutes is not None:
            begins = f"coalesce(time - lag(time) OVER sessions > {60_000 * gap_minutes}, true)"
        mixed = "coalesce(min(arm) OVER users <> max(arm) OVER users, false)"
        with explain_errors(connection, tables):
            rows: pd.DataFrame = connection.execute(
                "SELECT who IS NOT NULL AS who, coalesce(arm, '') AS arm, "
                "coalesce(part, '') AS part, value, shown, units, rows, beyond, "
                f"{mixed} AS mixed, CASE WHEN {mixed} THEN who END AS name FROM ("
                "SELECT who, arm, part, coalesce(sum(value), 0) AS value, "
                "count(value) AS shown, count(value) FILTER (begins) AS units, count(*) AS rows, "
                f"count(*) FILTER (abs(value) > {_LARGEST}) AS beyond "
                f"FROM (SELECT *, {begins} AS begins FROM "
                f"({' UNION ALL BY NAME '.join(selects)}) WINDOW sessions AS "
                "(PARTITION BY who, arm, part, value IS NULL ORDER BY time)) "
                "GROUP BY who, arm, part) AS groups "
                "WINDOW users AS (PARTITION BY groups.who) "
                "ORDER BY groups.arm, groups.who, groups.part"
            ).df()
    if beyond := int(rows["beyond"].sum()):
        raise InputError(
            f"{first_and_more(files)}: {measure} is infinite or beyond ±{_LARGEST:g} in {beyond:,} "
            "rows; correct the values, or remove them to leave the rows out"
        )
    return rows
