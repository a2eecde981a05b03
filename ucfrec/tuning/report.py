"""What a search found: the best settings as TOML, importances, and a page of all trials."""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ucfrec.files.atomic import atomic_file
from ucfrec.reporting.tables import markdown_table
from ucfrec.tuning.space import POLICY
from ucfrec.tuning.study import BEST, METRICS, Plan, config_of, finished

if TYPE_CHECKING:
    from optuna import Study

BEST_TOML, PAGE = "best.toml", "tuning.md"


def importances(study: "Study") -> dict[str, float]:
    """Share of the metric's variance that each setting explains (fANOVA: Hutter et al., ICML 2014),
    most important first; empty with fewer than four trials or none that differ.

    Of several policies, only settings that all trials have.
    """
    import optuna

    values = {trial.value for trial in study.trials if trial.state.name == "COMPLETE"}
    if len(values) < 4:
        return {}
    try:
        evaluator = optuna.importance.FanovaImportanceEvaluator(seed=0)
        return dict(optuna.importance.get_param_importances(study, evaluator=evaluator))
    except (RuntimeError, ValueError):
        return {}


def write_report(study: "Study", plan: Plan) -> None:
    """Write `best.toml` and `tuning.md` to the folder of the search."""
    config = config_of(plan, study.best_trial)
    names = [name for name in study.best_params if name != POLICY]
    if "train.steps" in names:
        names.append("train.warmup_steps")
    settings = {**plan.search.fixed, **{name: _field(config, name) for name in names}}
    file = plan.out / BEST_TOML
    command = f"ucfrec train {plan.store} --policy {config.policy_name} --config {file}"
    head = (
        f"# {plan.metric} {study.best_value:.6g}, of {len(finished(study))} trials\n# {command}\n"
    )
    with atomic_file(file) as scratch:
        scratch.write_text(head + _toml(settings), encoding="utf-8")
    with atomic_file(plan.out / PAGE) as scratch:
        scratch.write_text(_page(study, plan, command), encoding="utf-8")


def _page(study: "Study", plan: Plan, command: str) -> str:
    trials = sorted(
        (t for t in study.trials if t.state.is_finished()),
        key=lambda t: (t.value is None or t.state.name != "COMPLETE", -(t.value or 0.0)),
    )
    names = list(dict.fromkeys(name for trial in trials for name in trial.params))
    body = [
        (
            trial.number,
            f"{trial.value:.6g}" if trial.state.name == "COMPLETE" else _describe_end(trial),
            *(_short(trial.params.get(name)) for name in names),
        )
        for trial in trials
    ]
    shares = importances(study)
    parts = [
        f"# Search on {plan.store}",
        f"Metric: {plan.metric}, the {METRICS[plan.metric]}. The best trial, "
        f"{study.best_trial.number}, has {study.best_value:.6g}; its run is `{BEST}`. It was "
        "selected on validation rows: estimate it on the test split or on later logs.",
        f"To train it again: `{command}`",
        "## Importance",
        "Share of the variance of the metric between trials that a setting explains (fANOVA).",
        markdown_table(("setting", "importance"), [(n, f"{v:.2f}") for n, v in shares.items()])
        if shares
        else "Too few trials to compare.",
        "## Trials",
        markdown_table(("trial", plan.metric, *names), body),
    ]
    return "\n\n".join(parts) + "\n"


def _describe_end(trial: Any) -> str:
    if trial.state.name == "PRUNED":
        return "ended early"
    return str(trial.user_attrs.get("error", "interrupted"))[:80]


def _short(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _field(config: Any, name: str) -> Any:
    table, _, field = name.partition(".")
    return getattr(getattr(config, table), field)


def _toml(settings: Mapping[str, Any]) -> str:
    """Settings by `table.field` as TOML tables."""
    tables: dict[str, list[str]] = {}
    for name, value in sorted(settings.items()):
        table, _, field = name.partition(".")
        tables.setdefault(table, []).append(f"{field} = {_value(value)}")
    return "\n".join(f"[{table}]\n" + "\n".join(lines) + "\n" for table, lines in tables.items())


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, str):
        # A JSON string is a TOML string, but for a control character that JSON leaves as it is.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
