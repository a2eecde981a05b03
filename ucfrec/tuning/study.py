"""The search: trials of an Optuna study, in one or several processes, measured on validation rows;
the best settings as TOML, and a page of all trials."""

import json
import math
import shutil
import sqlite3
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import optuna
import torch
from optuna import Study, Trial, TrialPruned
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.errors import InputError, damage_explained, one_line
from ucfrec.evaluation.ranking import Later, Period, measure, rank_steps
from ucfrec.evaluation.ranking_table import PolicyRanker
from ucfrec.files.atomic import atomic_file, lock_path
from ucfrec.fitting.loop import Callbacks
from ucfrec.processes import block_ctrl_c, label_progress, pool_of_processes
from ucfrec.provenance import config_hash
from ucfrec.reporting.tables import format_value, markdown_table
from ucfrec.runs.config import Config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import continue_users
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.tuning.space import OF_REWARDS, POLICY, Search

VALUE = "value"
METRICS = {
    VALUE: "return of a session in the user model, under the decision rule that training selects",
    "ndcg": "NDCG of liked items among the k recommended, on validation rows",
    "gauc": "probability that a liked item scores above another one shown to the user, on "
    "validation rows",
}
_MEASURES = {"ndcg": "ndcg_liked", "gauc": "gauc"}
_NO_VALUE = (
    "has no estimated value, because its decision rule is not selected in simulated sessions; use "
    "--metric ndcg or gauc"
)
STUDY, BEST, STAGES, TRIAL = "study.db", "best", "stages", "trial-"
BEST_TOML, PAGE = "best.toml", "tuning.md"
_REMEDY = "restore it, or name another folder"
_COMPARED = 4  # earlier trials of the same policy, from which on a trial may be ended early


def measure_run(
    trained: TrainedPolicy,
    store: EpisodeStore,
    metric: str,
    k: int,
) -> float:
    """The metric of a finished run on its store, one of `METRICS`; higher is better. InputError if
    the run or its validation rows do not have the metric."""
    if metric == VALUE:
        rule = trained.record.rule
        if rule is None or rule.estimate is None:
            raise InputError(f"this training {_NO_VALUE}")
        return rule.estimate.value
    train, validation = store.split("train"), store.split("validation")
    if not trained.record.return_to_go.per_session:
        validation = continue_users(validation, train)
    users = validation.episode_values(schema.USER)
    period = Period.of(validation, users)
    ranker, k = PolicyRanker(trained).scores, min(k, period.n_items)
    rows = UserRows.of(validation, users, train)
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


def tune(plan: Plan, trials: int, workers: int = 1) -> Study:
    """Search until the study has so many trials, finished or ended early, by parallel `workers`.

    The best run lies in `plan.out / "best"`; those of other trials are deleted. `best.toml` has its
    settings, `tuning.md` all trials. InputError if the folder holds another search, numbers are out
    of range, a policy has no such metric here, no trial has a value, or the study is damaged.
    """
    if trials < 1 or workers < 1:
        raise InputError(f"{trials} trials and {workers} workers; give 1 or more of each")
    store, search = EpisodeStore.open(plan.store), plan.search
    are_equal = np.ptp(store.split("train").column(schema.REWARD)) == 0
    if are_equal and search.own_space is None:
        plan = replace(plan, search=replace(search, fixed=OF_REWARDS | dict(search.fixed)))
    for policy in search.policies if plan.metric == VALUE else ():
        config = search.config(policy, {})
        returns = config.policy.returns(store.record.source.session_by)
        if are_equal or not (store.has_items and config.rule.choose and returns.per_session):
            raise InputError(f"{store.path}: {policy} {_NO_VALUE}")
    with lock_path(plan.out, "tuned"), _open_study(plan.out) as study:
        with damage_explained(plan.out / STUDY, _REMEDY):
            _require_same(study, plan, store)
            # What a killed or interrupted process left is run once more, first of all.
            for trial in study.get_trials(states=(TrialState.RUNNING,)):
                study.tell(trial.number, state=TrialState.FAIL)
                if trial.params:
                    study.enqueue_trial(trial.params)
            left, seed = trials - len(list_finished(study)), search.seed + len(study.trials)
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
        _write_report(study, plan, _keep_best(study, plan))
    return study


def list_finished(study: Study) -> list[FrozenTrial]:
    """The trials that were measured or ended early."""
    return study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))


@contextmanager
def _open_study(folder: Path, seed: int = 0) -> Iterator[Study]:
    """The study of a folder, new if it has none, while it is used; errors of its file become an
    `InputError`.

    Args:
        seed: of what its trials draw.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / STUDY
    # In a URL, some characters of the path would have a meaning.
    connect = partial(sqlite3.connect, file, check_same_thread=False)
    try:
        with damage_explained(file, _REMEDY):
            storage = optuna.storages.RDBStorage("sqlite:///file", {"creator": connect})
            study = optuna.create_study(
                storage=storage,
                sampler=optuna.samplers.TPESampler(seed=seed),
                study_name="ucfrec",
                direction="maximize",
                load_if_exists=True,
            )
        yield study
    except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
        reason = str(error.__cause__ or error).partition("\n")[0]
        raise InputError(
            f"{file} cannot be read or written ({reason:.200}); free space on its disk, or "
            f"{_REMEDY}"
        ) from None


def _require_same(study: Study, plan: Plan, store: EpisodeStore) -> None:
    """Check that the study is of the same store, settings and metric, or begin it."""
    search = plan.search
    searched: dict[str, Any] = {"fixed": dict(search.fixed), "seed": search.seed}
    for policy in search.policies:
        searched[policy] = {name: asdict(values) for name, values in search.space(policy).items()}
    identity = {
        "store": store.record.fingerprint,
        "metric": plan.metric,
        "k": plan.k,
        "search": config_hash(searched),
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


def _run_trials(plan: Plan, count: int, seed: int) -> None:
    """Run some trials one after the other; also in a process of its own."""
    store = EpisodeStore.open(plan.store)
    # With the seed of the search, one that goes on would draw the first points once more.
    with _open_study(plan.out, seed) as study:
        for _ in range(count):
            trial = study.ask()
            try:
                study.tell(trial, _measure_trial(plan, store, trial))
            except TrialPruned:
                study.tell(trial, state=TrialState.PRUNED)
            except InputError as error:
                trial.set_user_attr("error", str(error))
                study.tell(trial, state=TrialState.FAIL)


def _measure_trial(plan: Plan, store: EpisodeStore, trial: Trial) -> float:
    """The metric of a trial, whose run is deleted unless it is the best."""

    def stop_hopeless(step: int, logged: Mapping[str, float]) -> None:
        """End the trial if its loss is above the median of its policy's, which are comparable."""
        if not plan.prune or (loss := logged.get("validation_loss")) is None:
            return
        losses = [
            earlier.intermediate_values[step]
            for earlier in trial.study.get_trials(deepcopy=False)
            if earlier.user_attrs.get(POLICY) == policy and step in earlier.intermediate_values
        ]
        trial.report(loss, step)
        if len(losses) >= _COMPARED and loss > np.median(losses):
            raise TrialPruned

    policy, values = plan.search.suggest(trial)
    trial.set_user_attr(POLICY, policy)
    config = plan.search.config(policy, values)
    run = _name_run(plan, config)
    shared, callbacks = plan.out / STAGES, Callbacks(on_validation=stop_hopeless)
    try:
        with label_progress(f"trial {trial.number}"):
            train_run(store, run, config, shared=shared, callbacks=callbacks)
            value = measure_run(TrainedPolicy.load(run), store, plan.metric, plan.k)
    except (InputError, TrialPruned):
        shutil.rmtree(run, ignore_errors=True)
        raise
    if value <= max(_list_values(trial.study), default=-math.inf):
        shutil.rmtree(run, ignore_errors=True)
    return value


def _name_run(plan: Plan, config: Config) -> Path:
    return plan.out / f"{TRIAL}{config_hash(asdict(config))}"


def _list_values(study: Study) -> list[float]:
    """The metric of each trial that was measured."""
    return [trial.values[0] for trial in study.get_trials(states=(TrialState.COMPLETE,))]


def _keep_best(study: Study, plan: Plan) -> Config:
    """Move the best run to its place and delete the others; returns its configuration."""
    if not _list_values(study):
        errors = (t.user_attrs["error"] for t in study.trials if "error" in t.user_attrs)
        reason = next(errors, "all were ended early; search more of them")
        raise InputError(f"no trial could be measured: {reason}")
    values = study.best_params
    config = plan.search.config(values.pop(POLICY, plan.search.policies[0]), values)
    run = _name_run(plan, config)
    if run.is_dir():
        shutil.rmtree(plan.out / BEST, ignore_errors=True)
        run.rename(plan.out / BEST)
    for folder in plan.out.glob(f"{TRIAL}*"):
        shutil.rmtree(folder, ignore_errors=True)
    return config


def importances(study: Study) -> dict[str, float]:
    """Share of the metric's variance that each setting of all trials explains (fANOVA: Hutter et
    al., ICML 2014), most important first; empty with fewer than four trials that differ."""
    if len(set(_list_values(study))) < 4:
        return {}
    try:
        evaluator = optuna.importance.FanovaImportanceEvaluator(seed=0)
        return dict(optuna.importance.get_param_importances(study, evaluator=evaluator))
    except (RuntimeError, ValueError):
        return {}


def _write_report(study: Study, plan: Plan, config: Config) -> None:
    """Write `best.toml` and `tuning.md` to the folder of the search."""
    file = plan.out / BEST_TOML
    chosen, tables = asdict(config), dict[str, str]()
    for name in sorted({*plan.search.fixed, *study.best_params} - {POLICY}):
        table, _, field = name.partition(".")
        tables.setdefault(table, f"\n[{table}]\n")
        tables[table] += f"{field} = {format_toml(chosen[table][field])}\n"
    command = one_line(
        f"ucfrec train {quote(str(plan.store))} --policy {quote(config.policy_name)} --config "
        f"{quote(str(file))} --out RUN"
    )
    best = study.best_trial
    head = f"{plan.metric} {best.value:.6g} in trial {best.number} of {len(study.trials)}"
    with atomic_file(file) as scratch:
        scratch.write_text(f"# {head}\n# {command}\n{''.join(tables.values())}", encoding="utf-8")
    shares = [(name, f"{share:.2f}") for name, share in importances(study).items()]
    parts = [
        f"# Search on {plan.store}",
        f"{head}; its run is `{BEST}`. The metric is the {METRICS[plan.metric]}. The trial was "
        "selected on validation rows: estimate it on the test split or on later logs.",
        f"To train it again: `{command}`",
        "## Importance",
        "Share of the variance of the metric between trials that a setting explains (fANOVA); none "
        "with too few trials.",
        markdown_table(("setting", "importance"), shares),
        "## Trials",
        _tabulate_trials(study, plan.metric),
    ]
    with atomic_file(plan.out / PAGE) as scratch:
        scratch.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _tabulate_trials(study: Study, metric: str) -> str:
    """The trials, best first; those without a value last."""
    trials = [trial for trial in study.trials if trial.state.is_finished()]
    trials.sort(key=lambda t: (t.state.name != "COMPLETE", -(t.value or 0.0)))
    names = dict.fromkeys(name for trial in trials for name in trial.params)
    body = []
    for trial in trials:
        error = trial.user_attrs.get("error", "ended early or interrupted")
        outcome = f"{trial.value:.6g}" if trial.state.name == "COMPLETE" else error
        settings = (format_value(trial.params.get(name)) for name in names)
        body.append((trial.number, outcome, *settings))
    return markdown_table(("trial", metric, *names), body)


def format_toml(value: Any) -> str:
    """A value of a setting as TOML, which differs from JSON in one control character only."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
