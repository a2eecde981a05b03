"""What measurements of a run add to its model card."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from ucfrec.acting.decision import DecisionRule
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.off_policy.evaluate import OffPolicyReport
from ucfrec.provenance import shorten_paths
from ucfrec.reporting.model_card import add_measurement
from ucfrec.results.row import ResultRow
from ucfrec.results.table import Ranking


def card_of_evaluation(run: Path, row: ResultRow) -> None:
    """Add a row of `ucfrec evaluate` to the card of its run."""
    names = ("R_cum", "R_avg_pooled", "length", "episodes", "coverage", "diversity")
    of = f"{row.environment}, {_rule(row)}, checkpoint {row.checkpoint}"
    values = {**_values(row, names), "seed": row.evaluation_seed}
    add_measurement(run, "ucfrec evaluate", of, values)


def card_of_estimates(run: Path, logs: Iterable[str], report: OffPolicyReport) -> None:
    """Add the estimate that the verdict of `ucfrec ope` is of to the card of the run."""
    rows = {row.method: row for row in report.rows}
    row = rows.get(report.verdict.estimator or LOGGED, rows[LOGGED])
    names = ("R_cum", "effective_sessions", "sessions", "lift", "probability_better", "overlap")
    files = ", ".join(map(shorten_paths, logs))
    of = f"{row.method} on {files}, {_rule(row)}"
    of += ", pages" if row.conditions["pages"] else ""
    discount = row.conditions["discount"]
    of += f", discount {discount:g}" if discount != 1 else ""
    values = _values(row, names) | {"logged": rows[LOGGED].value}
    said = (str(report.verdict), *(w for w in report.warnings if w not in report.verdict.reasons))
    add_measurement(run, "ucfrec ope", of, values, said)


def card_of_ranking(run: Path, row: ResultRow, on: str, said: Sequence[str] = ()) -> None:
    """Add a row of `ucfrec rank` on the logs `on`, and its warnings, to the card of its run."""
    intervals = row.details["intervals"]
    values: dict[str, object] = {}
    for name in Ranking.shown:
        values[name] = row.metrics.get(name)
        if name in row.metrics and name in intervals:
            low, high = intervals[name]
            values[name] = f"{row.metrics[name]:.4g} [{low:.4g}, {high:.4g}]"
    of = f"{on}, {_rule(row)}, k {row.conditions['k']}, checkpoint {row.checkpoint}"
    of += f", liked: {row.conditions['liked']}"
    add_measurement(run, "ucfrec rank", of, values, said)


def _rule(row: ResultRow) -> str:
    return str(DecisionRule.from_dict(row.details["decision_rule"], "a result row"))


def _values(row: ResultRow, names: Iterable[str]) -> dict[str, object]:
    """The named values, `R_cum` with its interval."""
    line = row.as_line()
    found = {name: line[name] for name in names if line.get(name) is not None}
    if row.interval is not None and "R_cum" in found:
        low, high = row.interval
        found["R_cum"] = f"{found['R_cum']:.4g} [{low:.4g}, {high:.4g}]"
    return found
