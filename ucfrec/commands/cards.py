"""What the commands add to the model cards of the runs that they measure."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ucfrec.off_policy.evaluate import OffPolicyReport


def card_of_evaluation(run: Path, row: Mapping[str, Any]) -> None:
    """Add a row of `ucfrec evaluate` to the card of its run."""
    from ucfrec.reporting.model_card import add_measurement

    names = ("R_cum", "R_avg_pooled", "length", "episodes", "coverage", "diversity", "seed")
    of = f"{row['environment']}, {_rule(row)}, checkpoint {row['checkpoint']}"
    add_measurement(run, "ucfrec evaluate", of, _values(row, "R_cum", names))


def card_of_estimates(run: Path, logs: Iterable[str], report: "OffPolicyReport") -> None:
    """Add the estimate that the verdict of `ucfrec ope` is of to the card of the run."""
    from ucfrec.off_policy.estimators import LOGGED
    from ucfrec.provenance import without_folders
    from ucfrec.reporting.model_card import add_measurement

    rows = {row["estimator"]: row for row in report.rows}
    row = rows.get(report.verdict.estimator or LOGGED, rows[LOGGED])
    names = ("R_cum", "effective_sessions", "sessions", "lift", "probability_better", "overlap")
    files = ", ".join(map(without_folders, logs))
    of = f"{row['estimator']} on {files}, {_rule(row)}"
    of += ", pages" if row["pages"] else ""
    of += f", discount {row['discount']:g}" if row["discount"] != 1 else ""
    values = _values(row, "R_cum", names) | {"logged": rows[LOGGED]["R_cum"]}
    said = (str(report.verdict), *(w for w in report.warnings if w not in report.verdict.reasons))
    add_measurement(run, "ucfrec ope", of, values, said)


def card_of_ranking(
    run: Path, row: Mapping[str, Any], measures: Iterable[str], on: str, said: Sequence[str] = ()
) -> None:
    """Add a row of `ucfrec rank` on the logs `on`, and its warnings, to the card of its run."""
    from ucfrec.reporting.model_card import add_measurement

    values: dict[str, object] = {}
    for name in (*measures, "coverage"):
        values[name] = row.get(name)
        if values[name] is not None and (interval := row.get(f"{name}_interval")) is not None:
            low, high = interval
            values[name] = f"{row[name]:.4g} [{low:.4g}, {high:.4g}]"
    of = f"{on}, {_rule(row)}, k {row['k']}, checkpoint {row['checkpoint']}"
    of += f", liked: {row['liked']}"
    add_measurement(run, "ucfrec rank", of, values, said)


def _rule(row: Mapping[str, Any]) -> str:
    from ucfrec.acting.decision import DecisionRule

    return str(DecisionRule.from_dict(row["decision_rule"], "a result row"))


def _values(row: Mapping[str, Any], main: str, names: Iterable[str]) -> dict[str, object]:
    """The named values, `main` with its interval."""
    found = {name: row[name] for name in names if row.get(name) is not None}
    low, high = row.get(f"{main}_low"), row.get(f"{main}_high")
    if main in found and low is not None and high is not None:
        found[main] = f"{found[main]:.4g} [{low:.4g}, {high:.4g}]"
    return found
