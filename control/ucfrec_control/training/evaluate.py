"""Trained policies in their environment: D4RL's normalised scores; losses by a distractor."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.rollout import Episodes, rollout
from ucfrec.errors import InputError
from ucfrec.provenance import config_hash, provenance
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import bootstrap_interval, summary
from ucfrec.runs.record import RUN, RunRecord
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.data.trajectories import PACKAGES, control_source
from ucfrec_control.environments.environments import (
    SIDE_BY_SIDE,
    AnyEnv,
    Wrap,
    environment_of_data,
    is_of_data,
    make_env,
    mismatches,
)
from ucfrec_control.environments.scores import find_kind, find_task, normalise
from ucfrec_control.training.rl_baselines import RLPolicy, RLRecord, read_run
from ucfrec_control.training.screening import TREATMENT, read_screening
from ucfrec_control.training.train import find_preset

Trained = TrainedPolicy | RLPolicy
CHECKPOINTS = ("last", "best")
RETURN = "return"
"""Checkpoint of `ucfrec_control.training.selection`."""
NO_TARGET = "no target return"
EVALUATE = "evaluate"
"""Suite of the rows."""


def evaluate_run(
    run: Path,
    *,
    episodes: int,
    seed: int,
    env_id: str | None = None,
    targets: Sequence[float] = (),
    checkpoints: Sequence[str] = CHECKPOINTS,
    distractor: float = 0.0,
    reference: tuple[float, float] | None = None,
) -> list[ResultRow]:
    """One result row for each checkpoint and target return; a score where reference returns are
    known, the return otherwise.

    All rows have the same initial states, after `SIDE_BY_SIDE` episodes if steps draw no random
    numbers. Distractors are fixed. IQL and CQL keep only their last checkpoint; they and behaviour
    cloning take no target return.

    Args:
        seed: of the first environment and the bootstrap; the next environment has the next seed.
        env_id: environment to evaluate in; None for that of the data.
        targets: target returns; empty for those of the preset, else the run's own.
        checkpoints: of "last", "best" and, where the training selected by return, "return".
        distractor: value that every distractor is fixed to (Appendix G.4: 0).
        reference: returns with scores 0 and 100; None for D4RL's of the task, if there are any.

    Raises:
        InputError: the run is not on a control store, or keeps none of `checkpoints`, or its
            environment is unknown or cannot be made, or `reference` does not rise.
    """
    rows: list[ResultRow] = []
    if isinstance(read_run(run), RLRecord) and "last" in checkpoints:
        checkpoints = ("last",)
    for checkpoint in checkpoints:
        trained = load_run(run, checkpoint)
        training = trained.record.finished
        if rows and training.best_step == training.steps:
            # The best checkpoint is the last: the same weights would give the same episodes.
            rows += [replace(row, checkpoint=checkpoint) for row in rows]
            continue
        environment = environment_of(trained, env_id)
        for rule in rules_of(trained, environment, targets):
            row = _row(trained, environment, rule, episodes, seed, distractor, reference)
            rows.append(replace(row, checkpoint=checkpoint))
    return rows


def load_run(run: Path, checkpoint: str) -> Trained:
    """The policy of a run on a control store.

    Raises:
        InputError: `run` is not on a control store, is damaged or not finished, or has no such
            checkpoint.
    """
    record = read_run(run)
    rl = isinstance(record, RLRecord)
    if record.policy is None:
        raise InputError(f"the training in {run} has not ended; train with the same command first")
    if rl and checkpoint != "last":
        raise InputError(
            f"{run} is of IQL or CQL, which keep their last checkpoint only; give --checkpoint last"
        )
    if checkpoint == RETURN and not (run / "policy" / f"{RETURN}.safetensors").exists():
        raise InputError(f"{run} has no checkpoint {RETURN}; train with --select-by-return")
    trained = RLPolicy(run) if rl else TrainedPolicy.load(run, checkpoint)
    if "env_id" not in trained.record.data.others:
        raise InputError(f"{run} is not a run of `ucfrec-control train`; evaluate it with `ucfrec`")
    control_source(trained.record.data, run / RUN)
    return trained


def _dataset(trained: Trained) -> dict[str, Any]:
    return control_source(trained.record.data, Path(RUN))


def environment_of(trained: Trained, env_id: str | None) -> str:
    """`env_id`, or `environment_of_data` if it is None, with its errors."""
    return env_id or environment_of_data(_dataset(trained))


def open_environment(
    trained: Trained,
    env_id: str,
    count: int,
    wrappers: Sequence[Wrap] = (),
    distractor: float = 0.0,
    **settings: Any,
) -> AnyEnv:
    """`count` environments that show what was logged where the policy was trained, distractors
    fixed to `distractor`; `settings` are arguments over those of the data.

    Raises:
        InputError: `env_id` cannot be made, or its sizes are not those of the training.
    """
    record, dataset = trained.record, _dataset(trained)
    data_settings = dataset.get("env_settings", {}) if is_of_data(env_id, dataset) else {}
    appended = [distractor] * len(dataset.get("distractors", []))
    env = make_env(env_id, count, appended, {**data_settings, **settings}, wrappers)
    observation_size = int(np.prod(env.single_observation_space.shape or ()))
    sizes = (observation_size, *(env.single_action_space.shape or ()))
    logged = record.sizes["state"] + len(record.dropped_observations)
    expected = (logged, record.sizes["action"])
    if sizes != expected:
        env.close()
        raise InputError(
            f"observations and actions of {env_id} have sizes {sizes}, the policy was trained "
            f"on {expected}"
        )
    return env


def method_of(record: RunRecord | RLRecord) -> str:
    """Name of the method of a run, with a suffix for how screening treated what it flagged."""
    screening = read_screening(record)
    if screening is None or not screening.flagged:
        return record.name
    return record.name + {"copies": "-screened", "drop": "-dropped"}[record.extra[TREATMENT]]


def takes_target(record: RunRecord | RLRecord) -> bool:
    """Whether the policy of a run acts by a target return."""
    return isinstance(record, RunRecord) and record.config.policy_name != "bc"


def rules_of(
    trained: Trained, env_id: str | None, targets: Sequence[float] = ()
) -> Sequence[DecisionRule | None]:
    """The target returns given, else those of the preset, as rules, else the run's own rule;
    (None,) for policies without a target return."""
    dataset, method = _dataset(trained), trained.record.config.policy_name
    if isinstance(trained, RLPolicy) or not takes_target(trained.record):
        return (None,)
    kind = find_kind(dataset["dataset"])
    task = find_task(env_id or dataset["env_id"] or dataset["dataset"])
    targets = targets or find_preset(task.name if task else "", kind, method).targets
    return [DecisionRule(target) for target in targets] or [trained.rule]


def choose_rule(
    trained: Trained, target: float | None = None, env_id: str | None = None
) -> DecisionRule | None:
    """The rule of one target return; with None, the first of `rules_of`. InputError if there is a
    target return, but the policy takes none."""
    if target is not None and not takes_target(trained.record):
        name = trained.record.config.policy_name
        raise InputError(f"no target return is taken by {name}; leave the target out")
    return rules_of(trained, env_id, () if target is None else (target,))[0]


def play(
    trained: Trained,
    env_id: str,
    rule: DecisionRule | None,
    episodes: int,
    seed: int,
    distractor: float = 0.0,
) -> Episodes:
    """Roll out `episodes` episodes; arguments and errors as of `open_environment`."""
    env = open_environment(trained, env_id, min(episodes, SIDE_BY_SIDE), distractor=distractor)
    try:
        actor = trained.actor(env.num_envs, rule)
        return rollout(env, actor, episodes, seed, describe=f"{trained.name} in {env_id}")
    finally:
        env.close()


def _row(
    trained: Trained,
    env_id: str,
    rule: DecisionRule | None,
    episodes: int,
    seed: int,
    distractor: float,
    reference: tuple[float, float] | None,
) -> ResultRow:
    record, dataset = trained.record, _dataset(trained)
    task = find_task(env_id)
    scale = reference or ((task.low, task.high) if task else None)
    began = time.perf_counter()
    rolled_out = play(trained, env_id, rule, episodes, seed, distractor)
    seconds = time.perf_counter() - began
    returns = rolled_out.returns
    scores = None if scale is None else normalise(returns, scale)
    values = returns if scores is None else scores
    conditions: dict[str, Any] = {"episodes": episodes, "distractor_fixed_to": distractor}
    conditions["lambda_mask"] = record.settings["policy"].get("lambda_mask")
    row = ResultRow(
        suite=EVALUATE,
        table=EVALUATE,
        task=dataset["dataset"],
        method=method_of(record),
        policy=record.config.policy_name,
        training_seed=record.seed,
        evaluation_seed=seed,
        conditions=conditions,
        config_hash=config_hash(record.settings),
        data_fingerprint=record.fingerprint,
        metric="return" if scores is None else "score",
        metrics={},
        interval=bootstrap_interval(values, seed) if episodes > 1 else None,
        environment=env_id,
        target_return=None if rule is None else rule.target,
        rule=NO_TARGET if rule is None else str(rule),
        wall_time_s=seconds,
        **provenance(PACKAGES),
    )
    metrics = {
        "score": None if scores is None else float(scores.mean()),
        "score_std": None if scores is None or episodes < 2 else summary(scores).sd,
        "return": float(returns.mean()),
        "length": float(rolled_out.lengths.mean()),
        "steps": record.finished.steps,
        "best_step": record.finished.best_step,
        "validation_loss": record.finished.best_validation,
        "acceptance": record.augmentation and record.augmentation.acceptance,
        "train_wall_time_s": record.wall_time_s,
        "distractors": dataset.get("distractors") or None,
        "dataset_versions": dataset["versions"],
        "warnings": mismatches(dataset, env_id) or None,
    }
    return row.extended(metrics)
