"""The search: trials of an Optuna study, in one or several processes, measured on validation rows;
the best settings as TOML, and a page of all trials."""

import json
import math
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.errors import InputError
from ucfrec.evaluation.ranking import Later, Period, measure, rank_steps
from ucfrec.evaluation.ranking_table import PolicyRanker
from ucfrec.files.atomic import atomic_file, lock_path
from ucfrec.fitting.loop import Callbacks
from ucfrec.processes import block_ctrl_c, label_progress, pool_of_processes
from ucfrec.provenance import config_hash
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import Config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.tuning.space import POLICY, Search

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import FrozenTrial

VALUE: Final = "value"
METRICS: Final = {
    VALUE: "return of a session in the user model, under the decision rule that training selects",
    "ndcg": "NDCG of liked items among the k recommended, on validation rows",
    "gauc": "probability that a liked item scores above another one shown to the user, on "
    "validation rows",
}
_MEASURES: Final = {"ndcg": "ndcg_liked", "gauc": "gauc"}
_OTHER_METRICS: Final = f"use --metric {' or '.join(_MEASURES)}"
STUDY, BEST, STAGES, TRIAL = "study.db", "best", "stages", "trial-"
BEST_TOML, PAGE = "best.toml", "tuning.md"
_COMPARED: Final = 4
"""Earlier trials of the same policy from which on a trial may be ended early."""


def measure_run(trained: TrainedPolicy, store: EpisodeStore, metric: str, k: int) -> float:
    """The metric of a finished run on its store, one of `METRICS`; higher is better.

    Raises:
        InputError: the run or its validation rows do not have the metric.
    """
    if metric == VALUE:
        rule = trained.record.rule
        if rule is None or rule.estimate is None:
            raise InputError(
                "the decision rule of this training is not selected in simulated sessions, so "
                f"there is no estimated value; {_OTHER_METRICS}"
            )
        return rule.estimate.value
    validation = store.split("validation")
    users = validation.episode_values(schema.USER)
    period = Period.of(validation, users)
    ranker, k = PolicyRanker(trained), min(k, period.n_items)
    rows = UserRows.of(validation, users, store.split("train"))
    ranked = rank_steps(ranker, Later(validation, rows, filter_seen=True), k)
    above, below = measure(period, ranked)[_MEASURES[metric]]
    if not below.any():
        raise InputError(
            f"{store.path}: no validation row is liked, so there is no {metric}; use another "
            "--metric, or a later split"
        )
    return float(np.sum(above) / np.sum(below))


@dataclass(frozen=True)
class Plan:
    """A search: where, over what, by what."""

    store: Path
    out: Path
    search: Search
    metric: str = "value"
    """One of `ucfrec.tuning.study.METRICS`."""
    k: int = 10
    """Items recommended, of the metric "ndcg"."""
    prune: bool = True
    """Whether trials are ended early whose validation loss is above the median of the others'."""

    @property
    def stored(self) -> dict[str, str]:
        """Address of the study's SQLite file, and the name of the study, for Optuna."""
        return {"storage": f"sqlite:///{self.out / STUDY}", "study_name": "ucfrec"}


def tune(plan: Plan, trials: int, workers: int = 1) -> "Study":
    """Search until the study has so many trials, finished or ended early, by parallel `workers`.

    The best run lies in `plan.out / "best"`; those of other trials are deleted. `best.toml` has its
    settings, `tuning.md` all trials.

    Raises:
        InputError: the folder holds another search, the numbers are out of range, the policies have
            no such metric on this store, or no trial could be measured.
    """
    optuna = _optuna()
    if trials < 1 or workers < 1:
        raise InputError(f"{trials} trials and {workers} workers; give 1 or more of each")
    store = EpisodeStore.open(plan.store)
    for policy in plan.search.policies if plan.metric == VALUE else ():
        config = plan.search.config(policy, {})
        returns = config.policy.returns(store.record.source.session_by)
        if not (store.has_items and config.rule.choose and returns.per_session):
            raise InputError(
                f"{store.path}: {policy} has no estimated value there, because its decision rule "
                f"is not selected in simulated sessions; {_OTHER_METRICS}"
            )
    with lock_path(plan.out, "tuned"):
        plan.out.mkdir(parents=True, exist_ok=True)
        study: Study = optuna.create_study(**plan.stored, direction="maximize", load_if_exists=True)
        _require_same(study, plan, store)
        _enqueue_again(study)
        left, seed = trials - len(list_finished(study)), plan.search.seed + len(study.trials)
        shares = [len(part) for part in np.array_split(range(max(left, 0)), workers) if len(part)]
        if len(shares) == 1:
            _run_trials(plan, shares[0], seed)
        elif shares:
            threads = max(1, torch.get_num_threads() // len(shares))
            seeds = range(seed, seed + 1000 * len(shares), 1000)
            with pool_of_processes(len(shares), partial(torch.set_num_threads, threads)) as pool:
                with block_ctrl_c():
                    results = pool.map(partial(_run_trials, plan), shares, seeds)
                list(results)
        _keep_best(study, plan)
        _write_report(study, plan)
    return study


def list_finished(study: "Study") -> "list[FrozenTrial]":
    """The trials that were measured or ended early."""
    return [trial for trial in study.trials if trial.state.name in ("COMPLETE", "PRUNED")]


def config_of(plan: Plan, trial: "FrozenTrial") -> Config:
    """The configuration of a trial."""
    values = dict(trial.params)
    policy = values.pop(POLICY, plan.search.policies[0])
    return plan.search.config(policy, values)


def _optuna() -> Any:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    return optuna


def _require_same(study: "Study", plan: Plan, store: EpisodeStore) -> None:
    """Check that the study is of the same store, settings and metric, or begin it."""
    search = plan.search
    own: dict[str, Any] = {"fixed": dict(search.fixed), "seed": search.seed}
    for policy in search.policies:
        own[policy] = {name: asdict(values) for name, values in search.space(policy).items()}
    identity = {
        "store": store.record.fingerprint,
        "metric": plan.metric,
        "k": plan.k,
        "search": config_hash(own),
    }
    earlier = study.user_attrs.get("about")
    if earlier is None:
        study.set_user_attr("about", identity)
    elif earlier != identity:
        changed = ", ".join(n for n, value in identity.items() if earlier.get(n) != value)
        raise InputError(
            f"{plan.out} is a search with another {changed}; name another folder, or give the same "
            "options to go on"
        )


def _enqueue_again(study: "Study") -> None:
    """Trials that a killed or interrupted process left are run once more, first of all."""
    import optuna

    again = set(study.user_attrs.get("again", []))
    for trial in study.trials:
        if trial.state.name == "RUNNING":
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
        elif trial.state.name != "FAIL":
            continue
        if trial.number not in again and trial.params and "error" not in trial.user_attrs:
            study.enqueue_trial(trial.params)
            again.add(trial.number)
    study.set_user_attr("again", sorted(again))


def _run_trials(plan: Plan, count: int, seed: int) -> None:
    """Run some trials one after the other; also in a process of its own."""
    optuna = _optuna()
    # A search that goes on must not draw the first points once more.
    sampler = optuna.samplers.TPESampler(seed=seed)
    study = optuna.load_study(**plan.stored, sampler=sampler)
    objective = partial(_objective, plan, EpisodeStore.open(plan.store))
    study.optimize(objective, n_trials=count, catch=(InputError,))


def _objective(plan: Plan, store: EpisodeStore, trial: "Trial") -> float:
    import optuna

    def stop_hopeless(step: int, logged: Mapping[str, float]) -> None:
        if plan.prune and "validation_loss" in logged:
            trial.report(logged["validation_loss"], step)
            if _is_hopeless(trial.study, trial.number, policy):
                raise optuna.TrialPruned

    policy, values = plan.search.suggest(trial)
    trial.set_user_attr(POLICY, policy)
    run = plan.out / TRIAL
    try:
        config = plan.search.config(policy, values)
        run = _name_run(plan, config)
        shared, callbacks = plan.out / STAGES, Callbacks(on_validation=stop_hopeless)
        with label_progress(f"trial {trial.number}"):
            train_run(store, run, config, shared=shared, callbacks=callbacks)
            value = measure_run(TrainedPolicy.load(run), store, plan.metric, plan.k)
    except (InputError, optuna.TrialPruned) as error:
        if isinstance(error, InputError):
            trial.set_user_attr("error", str(error))
        shutil.rmtree(run, ignore_errors=True)
        raise
    if value <= max(_list_values(trial.study), default=-math.inf):
        shutil.rmtree(run, ignore_errors=True)
    return value


def _name_run(plan: Plan, config: Config) -> Path:
    return plan.out / f"{TRIAL}{config_hash(asdict(config))}"


def _list_values(study: "Study") -> list[float]:
    """The metric of each trial that was measured."""
    trials = (trial for trial in study.trials if trial.state.name == "COMPLETE")
    return [trial.value for trial in trials if trial.value is not None]


def _is_hopeless(study: "Study", number: int, policy: str) -> bool:
    """Whether its loss is above the median of earlier trials of its policy at that step."""
    trials = study.get_trials(deepcopy=False)
    curve = trials[number].intermediate_values
    step = max(curve)
    # Losses of different policies are not of the same quantity.
    losses = [
        trial.intermediate_values[step]
        for trial in trials
        if trial.number != number
        and trial.user_attrs.get(POLICY) == policy
        and step in trial.intermediate_values
    ]
    return len(losses) >= _COMPARED and curve[step] > float(np.median(losses))


def _keep_best(study: "Study", plan: Plan) -> None:
    """Move the best run to its place and delete those of the other trials."""
    if not _list_values(study):
        errors = (t.user_attrs["error"] for t in study.trials if t.user_attrs.get("error"))
        reason = next(errors, "all were ended early; search more of them")
        raise InputError(f"no trial could be measured: {reason}")
    run = _name_run(plan, config_of(plan, study.best_trial))
    if run.is_dir():
        shutil.rmtree(plan.out / BEST, ignore_errors=True)
        run.rename(plan.out / BEST)
    for folder in plan.out.glob(f"{TRIAL}*"):
        shutil.rmtree(folder, ignore_errors=True)


def importances(study: "Study") -> dict[str, float]:
    """Share of the metric's variance that each setting of all trials explains (fANOVA: Hutter et
    al., ICML 2014), most important first; empty with fewer than four trials that differ."""
    import optuna

    if len(set(_list_values(study))) < 4:
        return {}
    try:
        evaluator = optuna.importance.FanovaImportanceEvaluator(seed=0)
        return dict(optuna.importance.get_param_importances(study, evaluator=evaluator))
    except (RuntimeError, ValueError):
        return {}


def _write_report(study: "Study", plan: Plan) -> None:
    """Write `best.toml` and `tuning.md` to the folder of the search."""
    config = config_of(plan, study.best_trial)
    names = {*study.best_params} - {POLICY}
    if "train.steps" in names:
        names.add("train.warmup_steps")
    chosen, tables = asdict(config), dict[str, str]()
    for name in sorted({*plan.search.fixed, *names}):
        table, _, field = name.partition(".")
        value = chosen[table][field] if name in names else plan.search.fixed[name]
        tables[table] = tables.get(table, f"\n[{table}]\n") + f"{field} = {format_toml(value)}\n"
    file = plan.out / BEST_TOML
    command = f"ucfrec train {plan.store} --policy {config.policy_name} --config {file}"
    count = len(list_finished(study))
    head = f"# {plan.metric} {study.best_value:.6g}, of {count} trials\n# {command}\n"
    with atomic_file(file) as scratch:
        scratch.write_text(head + "".join(tables.values()), encoding="utf-8")
    with atomic_file(plan.out / PAGE) as scratch:
        scratch.write_text(_page(study, plan, command), encoding="utf-8")


def _page(study: "Study", plan: Plan, command: str) -> str:
    trials = sorted(
        (t for t in study.trials if t.state.is_finished()),
        key=lambda t: (t.value is None or t.state.name != "COMPLETE", -(t.value or 0.0)),
    )
    names = list(dict.fromkeys(name for trial in trials for name in trial.params))
    body = []
    for trial in trials:
        outcomes = {"COMPLETE": f"{trial.value or 0:.6g}", "PRUNED": "ended early"}
        error = str(trial.user_attrs.get("error", "interrupted"))[:80]
        values = (trial.params.get(name, "") for name in names)
        cells = (f"{value:.4g}" if isinstance(value, float) else value for value in values)
        body.append((trial.number, outcomes.get(trial.state.name, error), *cells))
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


def format_toml(value: Any) -> str:
    """A value of a setting as TOML, which differs from JSON in one control character only."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
