"""The model card of a run: what it was trained on, how it acts, its limits, and what was measured.

`MODEL_CARD.md` lies in the run folder. It is written from `run.json` and from `measured.json`, to
which every evaluation of the run adds its newest values; nothing in it is typed in manually.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from ucfrec.acting.decision import DecisionRule
from ucfrec.errors import damage_explained
from ucfrec.files.atomic import atomic_file, claim, read_json, write_json
from ucfrec.files.record import CARD, MEASURED
from ucfrec.fitting.checkpoint import read_metrics
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.provenance import config_hash, shorten_paths
from ucfrec.reporting.tables import format_value, markdown_table
from ucfrec.results.rows import Ranking, ResultRow
from ucfrec.runs.record import REFIT, RunRecord, read_record
from ucfrec.runs.trained_policy import RULE, read_rule

if TYPE_CHECKING:
    from ucfrec.off_policy.evaluate import OffPolicyReport


def write_card(run: Path) -> Path:
    """Write the card of a finished run, from its record and what was measured so far. InputError if
    `run` is not a run folder."""
    record, card = read_record(run), run / CARD
    refitted = record.refit_of is not None or (run / REFIT / RunRecord.FILE).is_file()
    fit, times, splits = record.policy, record.data.time_range_ms, record.data.split_times_ms
    ranking = record.ranking
    if times and splits and not refitted:
        times = times[0], min(splits[0], times[1])
    window = [f"{datetime.fromtimestamp(time / 1000, UTC):%Y-%m-%d %H:%M}" for time in times or ()]
    data = describe_data(record) | {"reward": f"`{record.reward}`"}
    data["training window (UTC)"] = " to ".join(window) or None
    parts = [
        f"# Model card: {record.name}",
        _tabulate(
            {
                "policy": record.name,
                "configuration": config_hash(record.settings),
                "seed": record.seed,
                "training steps of the model": fit and fit.steps,
                "best validation loss": fit and fit.best_validation,
                "NDCG@10 on validation rows": ranking and ranking.ndcg,
                "that of items shown most lately": ranking and ranking.baseline_ndcg,
                "versions": ", ".join(f"{name} {n}" for name, n in record.versions.items()),
            }
        ),
        "## Training data",
        _tabulate(data),
        "## How it acts",
        _describe_rule(run, record),
        "## Limits",
        "\n".join(f"- {limit}" for limit in _list_limits(run, record, refitted, window) if limit),
        "## Measured",
        _describe_measurements(_read_measured(run)),
    ]
    with atomic_file(card) as scratch:
        scratch.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return card


def add_measurement(
    run: Path, how: str, of: str, values: Mapping[str, object], remarks: Sequence[str] = ()
) -> None:
    """Add what was measured of a run to its card; it replaces an older one of the same.

    Args:
        run: the run folder; one that this process may not write to is left as it is.
        how: the command, e.g. "ucfrec ope".
        of: what was measured on what, e.g. "DR on sessions.parquet, target return 5".
    """
    if not os.access(run, os.W_OK):
        return
    with claim(run / MEASURED, wait=True):
        unchanged = [row for row in _read_measured(run) if (row["how"], row["of"]) != (how, of)]
        measured = {"how": how, "of": of, "values": dict(values), "said": list(remarks)}
        write_json(run / MEASURED, [*unchanged, measured])
        write_card(run)


def add_evaluation(run: Path, row: ResultRow) -> None:
    """Add a row of `ucfrec evaluate` to the card of its run."""
    names = ("R_cum", "R_avg_pooled", "length", "episodes", "coverage", "diversity")
    of = f"{row.environment}, {_format_rule(row)}, checkpoint {row.checkpoint}"
    values = _select_values(row, names) | {"seed": row.evaluation_seed}
    add_measurement(run, "ucfrec evaluate", of, values)


def add_estimates(run: Path, logs: Iterable[str], report: "OffPolicyReport") -> None:
    """Add the estimate behind the verdict of `ucfrec ope` to the card of the run."""
    rows = {row.method: row for row in report.rows}
    verdict = report.verdict
    row = rows.get(verdict.estimator or LOGGED, rows[LOGGED])
    names = ["effective_sessions", "sessions", "overlap"]
    if verdict.lift.is_reliable:
        names += ["R_cum", "lift"]
    files = ", ".join(map(shorten_paths, logs))
    of = f"{row.method} on {files}, {_format_rule(row)}"
    of += ", lists" if row.conditions["positions"] else ""
    discount = row.conditions["discount"]
    of += f", discount {discount:g}" if discount != 1 else ""
    values = _select_values(row, names) | {"logged": rows[LOGGED].value}
    warnings = [text for text in report.warnings if text not in verdict.reasons]
    add_measurement(run, "ucfrec ope", of, values, [str(verdict), *warnings])


def add_ranking(run: Path, row: ResultRow, on: str, remarks: Sequence[str] = ()) -> None:
    """Add a row of `ucfrec rank` on the logs `on`, and its warnings, to the card of its run."""
    values = _select_values(row, Ranking.headings)
    of = f"{on}, {_format_rule(row)}, k {row.conditions['k']}, checkpoint {row.checkpoint}"
    of += f", liked: {row.conditions['liked']}"
    add_measurement(run, "ucfrec rank", of, values, remarks)


def _format_rule(row: ResultRow) -> str:
    return str(DecisionRule.from_dict(row.details["decision_rule"], "a result row"))


def _select_values(row: ResultRow, names: Sequence[str]) -> dict[str, object]:
    """The named values, with the intervals of those that have one."""
    values = dict(zip(names, map(row.as_line().get, names), strict=True))
    for name, (low, high) in row.intervals.items():
        if values.get(name) is not None:
            values[name] = f"{values[name]:.4g} [{low:.4g}, {high:.4g}]"
    return values


def _read_measured(run: Path) -> list[dict[str, Any]]:
    file, names = run / MEASURED, ("how", "of", "values", "said")
    with damage_explained(file, "restore or remove it"):
        rows = read_json(file) if file.exists() else []
        return [{name: row[name] for name in names} | {"values": {**row["values"]}} for row in rows]


def describe_data(record: RunRecord) -> dict[str, object]:
    """What a run was trained on."""
    sizes = record.sizes
    rows: dict[str, object] = {
        "files": ", ".join(PurePath(file).name for file in record.data.files) or None,
        "fingerprint": record.fingerprint[:12],
        "reward": record.reward,
        "sessions by": record.session_by,
        "training sessions": record.train_episodes,
        "training steps": record.train_steps,
        "users": record.data.users,
        "actions": f"{sizes['items']:,} items" if sizes["items"] else f"{sizes['action']} numbers",
        "state dimensions": sizes["state"],
        "mean return of a session": record.mean_return,
    }
    for level, value in record.return_quantiles.items():
        rows[f"{float(level):.0%} of returns are at most"] = value
    for name, tables in record.data.feature_tables.items():
        for file, kinds in tables.items():
            columns = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
            rows[f"{name} features in {file}"] = columns or "no columns"
    return {name: value for name, value in rows.items() if value is not None}


def _describe_rule(run: Path, record: RunRecord) -> str:
    text = "Its decision rule is not chosen yet."
    if (run / RULE).exists():
        text = (
            f"Its decision rule: {read_rule(run / RULE)}. `evaluate`, `ope`, `rank` and "
            "`recommend` act by it unless another is named; each measurement below names its own."
        )
    if not (numbers := describe_user_model(record)):
        return f"{text}\n\nIt was chosen without a user model."
    return f"{text}\n\nThe user model, which chose the rule:\n\n{_tabulate(numbers)}"


def _list_limits(
    run: Path,
    record: RunRecord,
    refitted: bool,
    window: Sequence[str],
) -> list[object]:
    """Sentences, and false values for those that do not hold."""
    items, unknown = record.sizes["items"], record.data.unknown_propensities
    whole = record.refit_of is not None
    warning, copies = record.learned_nothing(read_metrics(run / "policy")), record.augmentation
    return [
        whole and "It was trained on all rows of its store: only later logs can evaluate it.",
        refitted
        and not whole
        and "Once everything was chosen, it went on learning from all rows of its store: only "
        "later logs can evaluate it. What the test split shows is of the weights before that.",
        items and f"It knows {items:,} items and never shows another one.",
        window
        and f"It was not trained on anything after {window[1]} UTC; tastes and items change.",
        items
        and unknown is None
        and "Its logs have no propensities: its return cannot be estimated from them without a "
        "model of how items were chosen.",
        unknown and f"{unknown:,} steps of its logs have no propensity.",
        warning and f"{warning[0].upper()}{warning[1:]}.",
        copies and f"Counterfactual augmentation: {copies.verdict}",
        "A validation loss says how well logged choices are predicted, not the return: see what "
        "was measured.",
    ]


def _describe_measurements(measured: Sequence[Mapping[str, Any]]) -> str:
    if not measured:
        return (
            "Nothing yet: `ucfrec evaluate`, `ucfrec ope` and `ucfrec rank` write what they find "
            "here."
        )
    parts = []
    for row in measured:
        parts += [f"### {row['how']}: {row['of']}", _tabulate(row["values"])]
        if row["said"]:
            parts.append("\n".join(f"- {line}" for line in row["said"]))
    return "\n\n".join(parts)


def _tabulate(rows: Mapping[str, object]) -> str:
    body = [(name, format_value(value)) for name, value in rows.items() if value is not None]
    return markdown_table(["what", "value"], body)


def describe_user_model(record: RunRecord) -> dict[str, object]:
    """The held-out loss of every part of the user model beside simpler parts; empty without one."""
    reward, rule = record.reward_model, record.rule
    if reward is None or rule is None:
        return {}
    rows: dict[str, Any] = {
        "reward: loss of the mean": reward.base_loss,
        "reward: loss of item effects": reward.item_loss,
        "reward: loss of the model": reward.loss,
    }
    for effect in reward.effects:
        excluded = "" if effect.kept else ", excluded"
        rows[f"gain by {effect.effect}"] = f"{effect.gain:.5f} ± {effect.gain_error:.5f}{excluded}"
    if (end := rule.session_end) is not None:
        rows |= {f"session end: loss, {kind}": loss for kind, loss in end.loss.items()}
        rows["session end: kept"] = end.kept
    if rule.estimate is not None and rule.estimate.doubts:
        rows["value is not estimated, as"] = "; ".join(rule.estimate.doubts)
    elif (estimate := rule.estimate) is not None:
        rows["estimated value"] = f"{estimate.value:.4g} ± {estimate.error:.2g}"
        rows["in either half of the users"] = " and ".join(f"{v:.4g}" for v in estimate.halves)
        gain, error = estimate.correction
        rows["of it added by logged steps"] = f"{gain:+.3g} ± {error:.2g}"
    return rows
