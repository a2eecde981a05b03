"""Results of `ucfrec evaluate` and `ucfrec ope` in the report, and rules by their evidence."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ucfrec.errors import InputError
from ucfrec.evaluation.diversity import COLUMNS
from ucfrec.off_policy.estimators import LOGGED, SUITE
from ucfrec.reporting.charts import BarChart, LineChart, bar_chart, line_chart
from ucfrec.reporting.tables import Table, evaluation_line, shown
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import read_results
from ucfrec.runs.record import Candidate, RunRecord

_METRICS = ("R_avg_pooled", "R_avg_episode", "length", *COLUMNS, "target_return", "episodes")
_SEEDS = ("seed", "train_seed")
_WEIGHTS = ("effective_sessions", "largest_weight", "sessions", "overlap")
_STEP = "R_step"
"""Metric of rows per step, where only some steps of the logs have propensities."""


@dataclass(frozen=True)
class Estimates:
    """The estimates of one `ucfrec ope` for one policy."""

    name: str
    logged: ResultRow | None
    """Row of the logged sessions' own return."""
    rows: Sequence[ResultRow]
    """One row per estimator, without `logged`."""
    warnings: tuple[str, ...]
    steps: Sequence[ResultRow] = ()
    """Rows per step, with that of the logged steps."""


@dataclass(frozen=True)
class Results:
    """The result rows of a report."""

    environments: Mapping[str, Sequence[ResultRow]]
    """Environment to its rows of `ucfrec evaluate` or `ucfrec demo`."""
    estimates: Sequence[Estimates]


def results_of(paths: Sequence[Path]) -> Results:
    """Read result rows from JSON lines (files named `.jsonl`) or JSON.

    Raises:
        InputError: a file is missing or has a row without the required fields.
    """
    environments: dict[str, list[ResultRow]] = {}
    estimates: list[Estimates] = []
    for path in paths:
        rows = read_results(path)
        for number, row in enumerate(rows, start=1):
            of_steps = row.suite == SUITE and row.metric == _STEP
            session = row.metric == "R_cum" and (row.interval is not None or row.suite == SUITE)
            if not (session or of_steps):
                raise InputError(
                    f"{path}, row {number}, has no R_cum with an interval; give rows that `ucfrec "
                    "evaluate --json`, `ucfrec ope --json` or `ucfrec demo` wrote"
                )
            if row.suite != SUITE:
                environments.setdefault(row.environment or row.task, []).append(row)
        estimates += _estimates([row for row in rows if row.suite == SUITE])
    return Results(environments, estimates)


def _estimates(rows: Sequence[ResultRow]) -> list[Estimates]:
    """Group the rows of one file by `ucfrec ope` call; the rows of a call begin with `logged`."""
    groups: list[list[ResultRow]] = []
    for row in rows:
        if (row.method == LOGGED and row.metric != _STEP) or not groups:
            groups.append([])
        groups[-1].append(row)
    return [_policy_estimates(group) for group in groups]


def _policy_estimates(group: Sequence[ResultRow]) -> Estimates:
    steps = [row for row in group if row.metric == _STEP]
    sessions = [row for row in group if row.metric != _STEP]
    logged = next((row for row in sessions if row.method == LOGGED), None)
    rows = [row for row in sessions if row is not logged]
    first = rows[0] if rows else group[0]
    run, choice = first.conditions.get("run"), first.conditions.get("choice")
    name = first.policy
    name += "" if choice is None else f" ({choice})"
    name += "" if run is None else f" of {run}"
    if first.details.get("selection") is not None:
        name = f"{first.policy} ({first.details.get('candidate')})"
    warnings = (row.details.get("warnings") for row in group)
    said = (str(text) for texts in warnings if isinstance(texts, list) for text in texts)
    return Estimates(name, logged, rows, tuple(dict.fromkeys(said)), steps)


def environments(results: Results) -> list[tuple[BarChart, Table]]:
    """Bar chart and table of each environment."""
    return [_environment(environment, rows) for environment, rows in results.environments.items()]


def _environment(environment: str, rows: Sequence[ResultRow]) -> tuple[BarChart, Table]:
    names, lines = _row_names(rows), [evaluation_line(row) for row in rows]
    columns = [c for c in (*_METRICS, *_SEEDS) if any(line.get(c) is not None for line in lines)]
    body = [
        (name, [interval(row), *(_cell(line, column) for column in columns)])
        for name, row, line in zip(names, rows, lines, strict=True)
    ]
    table = Table(f"{environment}: means of episodes", "policy", ["R_cum", *columns], body)
    return _bars(f"R_cum in {environment}, with 95% intervals", names, rows), table


def estimates(results: Results) -> list[tuple[Estimates, BarChart, Table]]:
    """Bar chart and table of each policy with estimates from logs, and of those per step."""
    drawn = []
    for one in results.estimates:
        rows = [*([one.logged] if one.logged else []), *one.rows]
        names = ["logged sessions" if row.method == LOGGED else row.method for row in rows]
        body = [
            (name, [interval(row), *(shown(row.as_line().get(column)) for column in _WEIGHTS)])
            for name, row in zip(names, rows, strict=True)
        ]
        columns = ["mean return of a session", "effective sample", "share of the largest weight"]
        table = Table(f"Estimates for {one.name}", "", [*columns, "sessions", "overlap"], body)
        chart = _bars(f"Mean return of a session: {one.name}, with 95% intervals", names, rows)
        if one.steps:
            # The warnings come once, below both.
            drawn += [(replace(one, warnings=()), chart, table), (one, *_per_step(one))]
        else:
            drawn.append((one, chart, table))
    return drawn


def _per_step(one: Estimates) -> tuple[BarChart, Table]:
    names = ["logged steps" if row.method == LOGGED else row.method for row in one.steps]
    weights = ("effective_steps", "largest_weight")
    body = [
        (name, [interval(row), *(shown(row.as_line().get(column)) for column in weights)])
        for name, row in zip(names, one.steps, strict=True)
    ]
    columns = ["mean reward of a step", "effective sample", "share of the largest weight"]
    table = Table(f"Estimates per step for {one.name}", "", columns, body)
    title = f"Mean reward of a step with a propensity: {one.name}, with 95% intervals"
    return _bars(title, names, one.steps), table


def _bars(title: str, names: Sequence[str], rows: Sequence[ResultRow]) -> BarChart:
    bars = [
        (name, row.value, row.interval[0], row.interval[1])
        for name, row in zip(names, rows, strict=True)
        if row.interval is not None
    ]
    return bar_chart(title, bars)


def interval(row: ResultRow) -> str:
    """The value with its 95% interval, if it has one."""
    if row.interval is None:
        return f"{shown(row.value)} [–]"
    low, high = row.interval
    return f"{shown(row.value)} [{shown(low)}, {shown(high)}]"


def _row_names(rows: Sequence[ResultRow]) -> list[str]:
    """Policy of each row, with the fields that differ if a policy has several rows."""
    names, lines = [], [evaluation_line(row) for row in rows]
    for line in lines:
        same = [other for other in lines if other["policy"] == line["policy"]]
        fields = ("run", "checkpoint", *_SEEDS)
        differing = [key for key in fields if any(o.get(key) != line.get(key) for o in same)]
        parts = [line["policy"], *(f"{key} {_cell(line, key)}" for key in differing)]
        names.append(", ".join(parts))
    return names


def _cell(line: Mapping[str, Any], column: str) -> str:
    value = line.get(column)
    return str(value) if column in _SEEDS and value is not None else shown(value)


def frontier(record: RunRecord, candidates: Sequence[Candidate]) -> tuple[LineChart, Table] | None:
    """The highest estimated value of the rules that leave so many effective users of the log.

    None where the log has no propensities.
    """
    if record.rule is None:
        return None
    known = [
        (each.evidence.effective_users, each.value, each.rule, each.evidence.interval)
        for each in candidates
        if each.value is not None and each.evidence and each.evidence.effective_users is not None
    ]
    highest, curve, body = -math.inf, dict[float, float](), []
    for users, value, rule, ends in sorted(known, key=lambda one: (-one[0], -one[1])):
        if value > highest:
            highest = curve[users] = value
            between = f"{ends[0]:.4g} to {ends[1]:.4g}" if ends else "-"
            body.append((str(rule), [shown(value), f"{users:.0f}", between]))
    if not curve:
        return None
    curves = [("best rule", 0, curve)]
    chosen = [(users, value) for users, value, rule, _ in known if rule == record.rule.rule]
    if chosen:
        curves.append(("chosen rule", 1, dict(chosen[:1])))
    title = "Value in the search for a rule, against evidence"
    chart = line_chart(title, "effective users of the log", curves)
    head = ["value in the search", "effective users", "off-policy interval"]
    return chart, Table(title, "rule", head, body)
