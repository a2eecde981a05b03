"""Results of commands in the report: what each of them answers, one picture, and tables.

Conclusions call two results different only if their 95% intervals do not overlap, which is stricter
than a test of the difference at 5%.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from ucfrec.errors import damage_explained
from ucfrec.files.atomic import read_json
from ucfrec.off_policy.ab_test import Comparison
from ucfrec.off_policy.estimators import LOGGED, SUITE
from ucfrec.reporting.tables import Table, format_value
from ucfrec.results.charts import Chart, Interval, interval_chart
from ucfrec.results.evidence import Evidence
from ucfrec.results.rows import ResultRow, name_rows, read_results, select_intervals
from ucfrec.results.statistics import grouped, summary
from ucfrec.runs.record import UpdateVerdict
from ucfrec.updating.verdict import describe

_STEP = "R_step"
"""Metric of rows per step, where only some steps of the logs have propensities."""
_OF_SESSION = ("R_cum", "effective_sessions", "largest_weight", "sessions", "overlap")
_OF_STEP = (_STEP, "effective_steps", "largest_weight")
"""Columns of the tables of estimates."""
_WORDS = {"R_cum": "Return per episode"}
"""Names of metrics in conclusions."""


@dataclass(frozen=True)
class Finding:
    """What results say of one thing."""

    subject: str
    """What was measured."""
    answer: str
    """The conclusion, up to a colon, and the numbers or reasons that it has; or nothing."""
    tables: Sequence[Table] = ()
    remarks: Sequence[str] = ()
    """What to know of the numbers."""
    chart: Chart | None = None
    parts: list[Table] = field(default_factory=list)
    """Guardrails and groups, which a page shows unfolded."""


def read_findings(paths: Sequence[Path]) -> list[Finding]:
    """What the results in files of `--json` and files of result rows (`.jsonl`) say; all estimates
    from logs share a chart, that of the first of them. InputError if a file is missing or holds no
    results."""
    findings, rows = list[Finding](), list[ResultRow]()
    for path in paths:
        if path.suffix == ".json" and isinstance(values := read_json(path), dict) and values:
            with damage_explained(path, "write it again"):
                findings.append(_read_object(path.name, values))
        else:
            rows += read_results(path)
    kinds = grouped(rows, lambda row: row.suite == SUITE and row.metric in ("R_cum", _STEP))
    measured = kinds.get(False, ())
    tables = grouped(measured, lambda row: (row.table, row.environment or row.task, row.metric))
    with damage_explained(", ".join(map(str, paths)), "write the result rows again"):
        return [
            *_conclude_estimates(kinds.get(True, ())),
            *(_conclude_rows(f"{key[0]}, {key[1]}", group) for key, group in tables.items()),
            *findings,
        ]


def _conclude_estimates(rows: Sequence[ResultRow]) -> list[Finding]:
    """What `ucfrec ope` says of all rules in a picture, and of each; the rows of one begin with the
    logged sessions' own return."""
    calls: list[list[ResultRow]] = []
    for row in rows:
        if not calls or (row.method == LOGGED and row.metric != _STEP):
            calls.append([])
        calls[-1].append(row)
    if not calls:
        return []
    title = "Mean return of a session, with 95% intervals; grey: the data cannot say"
    intervals, level = select_intervals(rows)
    first = [next((r for r in call if r.method != LOGGED), call[0]) for call in calls]
    choice = str(first[0].details.get("selection", ""))
    findings = [Finding("The candidates", choice, chart=interval_chart(title, intervals, level))]
    for name, call, row in zip(name_rows(first), calls, first, strict=True):
        tables = [
            _tabulate(f"{caption} for {name}", columns, [r.method for r in group], group)
            for caption, columns in (("Estimates", _OF_SESSION), ("Estimates per step", _OF_STEP))
            if (group := [r for r in call if r.metric == columns[0]])
        ]
        answer = str(row.details.get("verdict", "The rows have no verdict of ucfrec ope"))
        if len(calls) > 1 and row.details.get("reliable") is not True:
            # The reasons are among the warnings.
            answer = answer.partition(":")[0]
        parts = [
            _tabulate_parts(f"{key.capitalize()} of {name}", row.details[key])
            for key in ("guardrails", "groups")
            if row.details.get(key)
        ]
        warnings = [*map(str, row.details.get("warnings", ()))]
        findings.append(Finding(name, answer, tables, warnings, parts=parts))
    return findings


def _tabulate_parts(caption: str, parts: Sequence[Mapping[str, Any]]) -> Table:
    """Guardrails or groups, each with a name, evidence and other values; where a reason speaks
    against the evidence, the reason takes the place of its number."""
    body = []
    for part in parts:
        name, *cells = part.values()
        for place, cell in enumerate(cells):
            if isinstance(cell, Mapping) and (cell["reasons"] or cell["low"] is None):
                cells[place] = "; ".join(["–", *cell["reasons"][:1]])
            elif isinstance(cell, Mapping):
                cells[place] = Interval(name, cell["value"], cell["low"], cell["high"]).numbers
        body.append((str(name), cells))
    return Table(caption, list(parts[0])[1:], body)


def _conclude_rows(place: str, rows: Sequence[ResultRow]) -> Finding:
    """How methods compare by their rows' metric, in a simulator or on logs."""
    rows, metric = sorted(rows, key=lambda row: -row.value), rows[0].metric
    columns = [*dict.fromkeys(name for row in rows for name in (metric, *row.metrics))]
    caption = f"{place}: {metric} with 95% intervals, and other measures"
    table = _tabulate(caption, columns, name_rows(rows), rows)
    title = f"{_WORDS.get(metric, metric)}, with 95% intervals: {place}"
    chart = interval_chart(title, select_intervals(rows)[0])
    return Finding(place, _compare(metric, rows), [table], (), chart)


def _read_object(name: str, values: Mapping[str, Any]) -> Finding:
    """What a JSON object of `ucfrec compare`, of an updated run or of another command says."""
    if "always" in values:
        return _conclude_comparison(TypeAdapter(Comparison).validate_python(values))
    if update := values.get("update"):
        return conclude_update(update["of"], UpdateVerdict.model_validate(update["verdict"]))
    rows = {key: value for key, value in values.items() if not isinstance(value, (dict, list))}
    return Finding(name, "", [Table.of_columns(name, {"value": rows})])


def _conclude_comparison(test: Comparison) -> Finding:
    """What an A/B test says."""
    intervals = _list_intervals({"as planned": test.planned, "whenever looked at": test.always})
    first, second = test.arms
    title = f"{test.column} per {test.per}: {second} less {first}, with 95% intervals"
    chart = interval_chart(title, intervals, ("no difference", 0.0))
    remarks = str(test).splitlines()[1:]
    return Finding(f"The A/B test of {first} and {second}", test.conclusion, (), remarks, chart)


def _list_intervals(evidence: Mapping[str, Evidence]) -> list[Interval]:
    return [
        Interval(name, entry.value or 0.0, entry.low or 0.0, entry.high or 0.0, entry.is_reliable)
        for name, entry in evidence.items()
    ]


def conclude_update(of: str, verdict: UpdateVerdict) -> Finding:
    """What the newest rows say of an updated run against the one `of` before."""
    intervals = _list_intervals(verdict.differences)
    title = f"Updated run less {of}, with 95% intervals; grey: the data cannot say"
    answer, *remarks = describe(verdict).splitlines()
    chart = interval_chart(title, intervals, ("no difference", 0.0))
    answer = answer.removeprefix("verdict").strip().capitalize()
    return Finding(f"The update of {of}", answer, (), remarks, chart)


def _tabulate(
    caption: str, columns: Sequence[str], names: Sequence[str], rows: Sequence[ResultRow]
) -> Table:
    """A table of the columns, the first with intervals."""
    body = []
    for name, row in zip(names, rows, strict=True):
        first, *values = map(row.as_line().get, columns)
        ends = ", ".join(map(format_value, row.interval or (None,)))
        body.append((name, [f"{format_value(first)} [{ends}]", *values]))
    return Table(caption, columns, body, "method")


_VERDICTS = {1: "Higher", -1: "Lower", 0: "Open, as intervals overlap or are not known"}


def _compare(metric: str, rows: Sequence[ResultRow]) -> str:
    """The best trained policy, and how the others compare: all intervals of the trainings of one
    with all intervals of the others."""
    groups = grouped(rows, lambda row: (row.method, row.checkpoint))
    policies, returns = [policy for policy, _ in groups], list[tuple[int, Interval]]()
    for (policy, checkpoint), group in groups.items():
        name = policy if policies.count(policy) == 1 else f"{policy}, checkpoint {checkpoint}"
        value = summary(row.value for row in group).mean
        lows, highs = zip(*(row.interval or (-math.inf, math.inf) for row in group), strict=True)
        interval = Interval(f"{name} ({format_value(value)})", value, min(lows), max(highs))
        returns.append((len({row.training_seed for row in group} - {None}), interval))
    by_value = sorted(returns, key=lambda pair: (not pair[0], -pair[1].value))
    (trainings, best), *rivals = by_value
    if not trainings:
        return f"Only built-in policies: {', '.join(policy.name for _, policy in returns)}."
    trained = sum(seeds > 0 for seeds, _ in returns)
    text = f"{best.name} has the highest {_WORDS.get(metric, metric).lower()} of {trained} trained:"
    if math.isfinite(best.low):
        text += f" 95% intervals {format_value(best.low)} to {format_value(best.high)};"
    text += f" trainings: {trainings}."
    sides = grouped(
        rivals,
        lambda pair: (pair[1].low > best.high) - (pair[1].high < best.low),
    )
    for side, beside in sides.items():
        text += f" {_VERDICTS[side]}: {', '.join(policy.name for _, policy in beside)}."
    if trained == len(returns):
        text += " No built-in policy (random, logging or best) was evaluated to compare it with."
    if trainings < 2:
        text += " It was trained once; the spread over training seeds is unknown."
    return text
