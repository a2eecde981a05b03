"""Results of `ucfrec evaluate` and `ucfrec ope` in the report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ucfrec.errors import InputError
from ucfrec.evaluation.diversity_columns import COLUMNS
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.reporting import charts
from ucfrec.reporting.evaluation_rows import read_evaluations
from ucfrec.reporting.tables import Table, shown

Row = dict[str, Any]

_INTERVAL = ("R_cum", "R_cum_low", "R_cum_high")
_METRICS = ("R_avg_pooled", "R_avg_episode", "length", *COLUMNS, "target_return", "episodes")
_SEEDS = ("seed", "train_seed")
_WEIGHTS = ("effective_sessions", "largest_weight", "sessions", "overlap")


@dataclass(frozen=True)
class Estimates:
    """The estimates of one `ucfrec ope` for one policy."""

    name: str
    logged: Row | None
    """Row of the logged sessions' own return."""
    rows: Sequence[Row]
    """One row per estimator, without `logged`."""
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Results:
    """The result rows of a report."""

    environments: Mapping[str, Sequence[Row]]
    """Environment to its rows of `ucfrec evaluate` or `ucfrec demo`."""
    estimates: Sequence[Estimates]


def read_results(paths: Sequence[Path]) -> Results:
    """Read result rows from JSON lines (files named `.jsonl`) or JSON.

    Raises:
        InputError: a file is missing or has a row without the required fields.
    """
    environments: dict[str, list[Row]] = {}
    estimates: list[Estimates] = []
    for path in paths:
        rows = _rows_of(path)
        for row in rows:
            if "estimator" not in row:
                environments.setdefault(row["environment"], []).append(row)
        estimates += _estimates([row for row in rows if "estimator" in row])
    return Results(environments, estimates)


def _rows_of(path: Path) -> list[Row]:
    rows = read_evaluations(path)
    for number, row in enumerate(rows, start=1):
        known = row if isinstance(row, dict) else {}
        texts = ("estimator" if "estimator" in known else "environment", "policy")
        lacking = [name for name in texts if not isinstance(known.get(name), str)]
        # An estimate that nothing but a model stands behind has no interval.
        open_ended = "estimator" in known and known.get("R_cum_low") is None
        needed = _INTERVAL[:1] if open_ended else _INTERVAL
        lacking += [name for name in needed if not _finite(known.get(name))]
        lacking += [
            name
            for name in (*_METRICS, *_WEIGHTS)
            if known.get(name) is not None and not isinstance(known[name], (int, float))
        ]
        if not isinstance(known.get("warnings", []), list):
            lacking.append("warnings")
        if lacking:
            raise InputError(
                f"{path}, row {number}, has no usable {', '.join(lacking)}; give rows that "
                "`ucfrec evaluate --json`, `ucfrec ope --json` or `ucfrec demo` wrote"
            )
    return rows


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _estimates(rows: Sequence[Row]) -> list[Estimates]:
    """Group the rows of one file by `ucfrec ope` call; the rows of a call begin with `logged`."""
    groups: list[list[Row]] = []
    for row in rows:
        if row["estimator"] == LOGGED or not groups:
            groups.append([])
        groups[-1].append(row)
    return [_policy_estimates(group) for group in groups]


def _policy_estimates(group: Sequence[Row]) -> Estimates:
    logged = next((row for row in group if row["estimator"] == LOGGED), None)
    rows = [row for row in group if row is not logged]
    policy = rows[0] if rows else group[0]
    run, choice = policy.get("run"), policy.get("choice")
    name = policy["policy"]
    name += "" if choice is None else f" ({choice})"
    name += "" if run is None else f" of {run}"
    if policy.get("selection") is not None:
        name = f"{policy['policy']} ({policy['candidate']})"
    warnings = dict.fromkeys(str(text) for row in group for text in row.get("warnings", []))
    return Estimates(name, logged, rows, tuple(warnings))


def environments(results: Results) -> list[tuple[charts.BarChart, Table]]:
    """Bar chart and table of each environment."""
    return [_environment(environment, rows) for environment, rows in results.environments.items()]


def _environment(environment: str, rows: Sequence[Row]) -> tuple[charts.BarChart, Table]:
    names = _row_names(rows)
    columns = [c for c in (*_METRICS, *_SEEDS) if any(row.get(c) is not None for row in rows)]
    body = [
        (name, [interval(row), *(_cell(row, column) for column in columns)])
        for name, row in zip(names, rows, strict=True)
    ]
    table = Table(f"{environment}: means of episodes", "policy", ["R_cum", *columns], body)
    return _bars(f"R_cum in {environment}, with 95% intervals", names, rows), table


def estimates(results: Results) -> list[tuple[Estimates, charts.BarChart, Table]]:
    """Bar chart and table of each policy with estimates from logs."""
    drawn = []
    for one in results.estimates:
        rows = [*([one.logged] if one.logged else []), *one.rows]
        names = [_estimator(row) for row in rows]
        body = [
            (name, [interval(row), *(shown(row.get(column)) for column in _WEIGHTS)])
            for name, row in zip(names, rows, strict=True)
        ]
        columns = ["mean return of a session", "effective sample", "share of the largest weight"]
        table = Table(f"Estimates for {one.name}", "", [*columns, "sessions", "overlap"], body)
        chart = _bars(f"Mean return of a session: {one.name}, with 95% intervals", names, rows)
        drawn.append((one, chart, table))
    return drawn


def _estimator(row: Row) -> str:
    return "logged sessions" if row["estimator"] == LOGGED else str(row["estimator"])


def _bars(title: str, names: Sequence[str], rows: Sequence[Row]) -> charts.BarChart:
    bars = [
        (name, float(row["R_cum"]), float(row["R_cum_low"]), float(row["R_cum_high"]))
        for name, row in zip(names, rows, strict=True)
        if row["R_cum_low"] is not None
    ]
    return charts.bar_chart(title, bars)


def interval(row: Row) -> str:
    """R_cum with its 95% interval, if it has one."""
    if row["R_cum_low"] is None:
        return f"{shown(row['R_cum'])} [–]"
    return f"{shown(row['R_cum'])} [{shown(row['R_cum_low'])}, {shown(row['R_cum_high'])}]"


def _row_names(rows: Sequence[Row]) -> list[str]:
    """Policy of each row, with the fields that differ if a policy has several rows."""
    names = []
    for row in rows:
        same = [other for other in rows if other["policy"] == row["policy"]]
        fields = ("run", "checkpoint", *_SEEDS)
        differing = [key for key in fields if any(o.get(key) != row.get(key) for o in same)]
        names.append(", ".join([row["policy"], *(f"{key} {_cell(row, key)}" for key in differing)]))
    return names


def _cell(row: Row, column: str) -> str:
    value = row.get(column)
    return str(value) if column in _SEEDS and value is not None else shown(value)
