"""Results of `ucfrec evaluate` and `ucfrec ope` in the report: conclusions, charts and tables.

Conclusions call two results different only if their 95% intervals do not overlap, which is stricter
than a test of the difference at 5%.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import COLUMNS
from ucfrec.off_policy.estimators import LOGGED, SUITE
from ucfrec.reporting.charts import Chart, Interval, interval_chart, line_chart
from ucfrec.reporting.tables import Table, evaluation_line, format_value
from ucfrec.results.rows import ResultRow, read_results
from ucfrec.results.statistics import grouped
from ucfrec.runs.record import Candidate, RunRecord

_METRICS = ("R_avg_pooled", "R_avg_episode", "length", *COLUMNS, "target_return", "episodes")
_SEEDS = ("seed", "train_seed")
_STEP = "R_step"
"""Metric of rows per step, where only some steps of the logs have propensities."""


@dataclass(frozen=True)
class Estimates:
    """The estimates of one `ucfrec ope` for one policy."""

    name: str
    rows: Sequence[ResultRow]
    """One row per estimator, and that of the logged sessions' own return."""
    warnings: tuple[str, ...] = ()
    steps: Sequence[ResultRow] = ()
    """Rows per step, with that of the logged steps."""


Environments = Mapping[str, Sequence[ResultRow]]
"""Environment to its rows of `ucfrec evaluate` or `ucfrec demo`."""


def read_evidence(paths: Sequence[Path]) -> tuple[Environments, Sequence[Estimates]]:
    """Read result rows from JSON lines (files named `.jsonl`) or JSON.

    Raises:
        InputError: a file is missing or has a row without the required fields.
    """
    environments: dict[str, list[ResultRow]] = {}
    estimates: list[Estimates] = []
    for path in paths:
        calls: list[list[ResultRow]] = []
        for number, row in enumerate(read_results(path), start=1):
            by_step = row.suite == SUITE and row.metric == _STEP
            session = row.metric == "R_cum" and (row.interval is not None or row.suite == SUITE)
            if not (session or by_step):
                raise InputError(
                    f"{path}, row {number}, has no R_cum with an interval; give rows that `ucfrec "
                    "evaluate --json`, `ucfrec ope --json` or `ucfrec demo` wrote"
                )
            if row.suite != SUITE:
                environments.setdefault(row.environment or row.task, []).append(row)
                continue
            # The rows of one call of `ucfrec ope` begin with `logged`.
            if (row.method == LOGGED and not by_step) or not calls:
                calls.append([])
            calls[-1].append(row)
        estimates += map(_group_estimates, calls)
    return environments, estimates


def _group_estimates(group: Sequence[ResultRow]) -> Estimates:
    steps = [row for row in group if row.metric == _STEP]
    rows = [row for row in group if row.metric != _STEP]
    first = next((row for row in rows if row.method != LOGGED), group[0])
    name, conditions = first.policy, first.conditions
    if first.details.get("selection") is not None:
        name += f" ({first.details.get('candidate')})"
    else:
        name += f" ({conditions['choice']})" if conditions.get("choice") is not None else ""
        name += f" of {conditions['run']}" if conditions.get("run") is not None else ""
    warnings = (row.details.get("warnings") for row in group)
    texts = (str(text) for texts in warnings if isinstance(texts, list) for text in texts)
    return Estimates(name, rows, tuple(dict.fromkeys(texts)), steps)


def find_quoted(rows: Sequence[ResultRow]) -> ResultRow | None:
    """The row that the verdict is of, if it has an interval."""
    quoted = (row for row in rows if row.interval and row.method == row.details.get("verdict_of"))
    return next(quoted, None)


def draw_environments(environments: Environments) -> list[tuple[Chart, Table]]:
    """Bar chart and table of each environment."""
    pictures = []
    for environment, rows in environments.items():
        lines, named = [evaluation_line(row) for row in rows], []
        for row, line in zip(rows, lines, strict=True):
            # The policy, with the fields that differ if it has several rows.
            same = [other for other in lines if other["policy"] == line["policy"]]
            fields = ("run", "checkpoint", *_SEEDS)
            differing = [key for key in fields if any(o.get(key) != line.get(key) for o in same)]
            parts = (f"{key} {format_value(line.get(key))}" for key in differing)
            named.append((", ".join([line["policy"], *parts]), row))
        columns = [c for c in (*_METRICS, *_SEEDS) if any(ln.get(c) is not None for ln in lines)]
        title, caption = f"R_cum in {environment}", f"{environment}: means of episodes"
        heads = {column: column for column in columns}
        pictures.append(_draw_rows(title, caption, {"R_cum": "R_cum"} | heads, named, "policy"))
    return pictures


def draw_estimates(
    all_estimates: Sequence[Estimates],
) -> list[tuple[list[tuple[Chart, Table]], tuple[str, ...]]]:
    """Charts and tables, per session and step, and warnings of each policy with estimates."""
    largest = {"largest_weight": "share of the largest weight"}
    by_session = {"R_cum": "mean return of a session", "effective_sessions": "effective sample"}
    by_session |= {**largest, "sessions": "sessions", "overlap": "overlap"}
    by_step = {_STEP: "mean reward of a step", "effective_steps": "effective sample", **largest}
    pictures = []
    for estimates in all_estimates:
        parts, name = [], estimates.name
        for rows, unit, columns, title, caption in (
            (estimates.rows, "sessions", by_session, "Mean return of a session", "Estimates"),
            (estimates.steps, "steps", by_step, "Mean reward of a step with a propensity",
             "Estimates per step"),
        ):  # fmt: skip
            named = [(f"logged {unit}" if r.method == LOGGED else r.method, r) for r in rows]
            if named:
                parts.append(
                    _draw_rows(f"{title}: {name}", f"{caption} for {name}", columns, named)
                )
        pictures.append((parts, estimates.warnings))
    return pictures


def _draw_rows(
    title: str,
    caption: str,
    columns: Mapping[str, str],
    named: Sequence[tuple[str, ResultRow]],
    corner: str = "",
) -> tuple[Chart, Table]:
    """Chart of the intervals, and table of the columns, {value: head}, the first with intervals."""
    intervals, body = [], []
    for name, row in named:
        first, *values = (evaluation_line(row).get(key) for key in columns)
        ends = "–"
        if row.interval is not None:
            low, high = row.interval
            intervals.append(Interval(name, row.value, low, high))
            ends = f"{format_value(low)}, {format_value(high)}"
        body.append((name, [f"{format_value(first)} [{ends}]", *values]))
    chart = interval_chart(f"{title}, with 95% intervals", intervals)
    return chart, Table(caption, list(columns.values()), body, corner)


def draw_forest(all_estimates: Sequence[Estimates]) -> Chart | None:
    """Draw the estimate that each verdict is of; None if no policy has one with an interval."""
    intervals, logged = [], set()
    for estimates in all_estimates:
        logged |= {row.value for row in estimates.rows if row.method == LOGGED}
        row = find_quoted(estimates.rows)
        if row is not None and row.interval is not None:
            (low, high), reliable = row.interval, row.details.get("reliable") is True
            name = f"{estimates.name}: {row.method}"
            intervals.append(Interval(name, row.value, low, high, reliable))
    if not intervals:
        return None
    # The line is of one set of logs; several have a line each in their own charts.
    title = "Mean return of a session by policy, with 95% intervals; dashed: do not rely on it"
    return interval_chart(title, intervals, logged.pop() if len(logged) == 1 else None)


def draw_frontier(record: RunRecord, candidates: Sequence[Candidate]) -> tuple[Chart, Table] | None:
    """The highest estimated value of the rules that leave so many effective users of the log; None
    where the log has no propensities."""
    if record.rule is None:
        return None
    known = [
        (c.evidence.effective_users, c.value, c.rule, c.evidence.interval)
        for c in candidates
        if c.value is not None and c.evidence and c.evidence.effective_users is not None
    ]
    curve, body = dict[float, float](), []
    for users, value, rule, ends in sorted(known, key=lambda place: (-place[0], -place[1])):
        if value > max(curve.values(), default=-math.inf):
            curve[users] = value
            between = f"{ends[0]:.4g} to {ends[1]:.4g}" if ends else "-"
            body.append((str(rule), [value, f"{users:.0f}", between]))
    if not curve:
        return None
    curves = [("best rule", 0, curve)]
    if chosen := [(users, value) for users, value, rule, _ in known if rule == record.rule.rule]:
        curves.append(("chosen rule", 1, dict(chosen[:1])))
    title = "Value in the search for a rule, against evidence"
    chart = line_chart(title, "effective users of the log", curves)
    head = ["value in the search", "effective users", "off-policy interval"]
    return chart, Table(title, head, body, "rule")


NO_RESULTS = (
    "No results are given, so the returns of these policies are unknown. A validation loss "
    "measures how well logged choices are predicted, not the return. Evaluate the policies in a "
    "simulator (ucfrec evaluate --json) or from logs (ucfrec ope --json), and give the rows with "
    "--results."
)


@dataclass(frozen=True)
class _Return:
    """Return of one policy in one environment, over all its rows."""

    policy: str
    trained: bool
    trainings: int
    """Number of distinct training seeds."""
    value: float
    """Mean R_cum over rows."""
    low: float
    high: float
    """Lowest and highest end of the rows' 95% intervals."""

    def __str__(self) -> str:
        return f"{self.policy} ({format_value(self.value)})"


_VERDICTS = {1: "Higher", -1: "Lower", 0: "Open, as intervals overlap"}


def conclude(environments: Environments, all_estimates: Sequence[Estimates]) -> list[str]:
    """One paragraph per environment, then one per policy with estimates from logs."""
    conclusions = [_conclude(name, rows) for name, rows in environments.items()]
    return conclusions + [_quote(estimates) for estimates in all_estimates] or [NO_RESULTS]


def _collect_returns(rows: Sequence[ResultRow]) -> list[_Return]:
    """One summary per policy and checkpoint, in order of first appearance."""
    groups = grouped(rows, lambda row: (row.method, row.checkpoint))
    policies, returns = [policy for policy, _ in groups], []
    for (policy, checkpoint), group in groups.items():
        name = policy if policies.count(policy) == 1 else f"{policy}, checkpoint {checkpoint}"
        seeds = {row.training_seed for row in group}
        value = sum(row.value for row in group) / len(group)
        lows, highs = zip(*(row.interval for row in group if row.interval), strict=True)
        returns.append(_Return(name, seeds != {None}, len(seeds), value, min(lows), max(highs)))
    return returns


def _conclude(environment: str, rows: Sequence[ResultRow]) -> str:
    """The best trained policy, and how the others compare: all intervals with all intervals."""
    returns = sorted(_collect_returns(rows), key=lambda own: (-own.trained, -own.value))
    (best, *others), trained = returns, sum(own.trained for own in returns)
    if not trained:
        names = ", ".join(map(str, returns))
        return f"In {environment}, only built-in policies were evaluated: {names}."
    text = (
        f"In {environment}, {best} has the highest return per episode of {trained} trained (95% "
        f"intervals {format_value(best.low)} to {format_value(best.high)}; trainings: "
        f"{best.trainings})."
    )
    groups = grouped(others, lambda own: _VERDICTS[(own.low > best.high) - (own.high < best.low)])
    text += "".join(f" {words}: {', '.join(map(str, own))}." for words, own in groups.items())
    if trained == len(returns):
        text += " No built-in policy (random, logging or best) was evaluated to compare it with."
    if best.trainings < 2:
        text += " It was trained once; the spread over training seeds is unknown."
    return text


def _quote(estimates: Estimates) -> str:
    """What `ucfrec ope` concluded of a policy, as its rows say."""
    for row in estimates.rows:
        if verdict := row.details.get("verdict"):
            return f"For {estimates.name}: {verdict}."
    return f"For {estimates.name}, the rows have no verdict of ucfrec ope."
