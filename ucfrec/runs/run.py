"""Train a policy (Algorithm 1) and keep everything it produces in a run folder."""

import os
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ucfrec import __version__, schema
from ucfrec.acting.decision import best_items
from ucfrec.acting.scorer import Scorer, logged_scores
from ucfrec.choosing.by_ranking import choose_by_ranking, measure_ranking
from ucfrec.choosing.by_simulation import choose_by_simulation
from ucfrec.choosing.choice import Problem, RuleRecord
from ucfrec.counterfactual.augmentation import MODELS, AugmentationReport, augment_episodes
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.episodes.windows import AUGMENTED, AugmentedEpisodes
from ucfrec.files.atomic import (
    atomic_file,
    atomic_folder,
    claim,
    lock_path,
    remove_leftovers,
    write_json,
)
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import load_tensors
from ucfrec.fitting.loop import SILENT, Callbacks
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import note_ignored
from ucfrec.processes import phase, random_state_kept
from ucfrec.provenance import config_hash
from ucfrec.runs.config import Config
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.record import CANDIDATES, RUN, RunRecord, place_of, read_augmentation
from ucfrec.runs.start import (
    begin,
    continue_users,
    new_policy,
    require_startable,
    rule_to_start_from,
    start_warm,
    training_views,
)
from ucfrec.runs.trained_policy import (
    AUGMENTATION,
    INPUTS,
    RETURNS,
    REWARD_MODEL,
    RULE,
    TrainedPolicy,
    read_rule,
)
from ucfrec.user_model.model import UserModel

SAMPLES = "samples.json"
_SESSIONS, _HISTORY, _ITEMS = 3, 5, 5


def share_stage(
    folder: Path | None,
    inputs: Mapping[str, Any],
    stage: str,
    out: Path,
    names: Sequence[str],
    make: Callable[[], object],
) -> None:
    """Copy the files of a stage to the run folder `out`, or make them there and keep a copy.

    Another process that needs the same stage waits until it is made.

    Args:
        folder: of stages that several runs have in common, each in a folder of its own; None to
            make them.
        inputs: all that the stage depends on: data, settings, seed. Another version of the package
            makes its own.
        names: files and folders of the stage in `out`, those that are made; the last one marks the
            stage as finished, and is copied last. No file is ever there in part.
    """
    if folder is None:
        make()
        return
    stage_folder = folder / config_hash({**inputs, "stage": stage, "version": __version__})
    with claim(stage_folder, wait=True):
        if stage_folder.exists():
            _copy(stage_folder, out, names)
            return
        make()
        with atomic_folder(stage_folder) as scratch:
            _copy(out, scratch, names)


def _copy(source: Path, to: Path, names: Iterable[str]) -> None:
    for name in names:
        if (source / name).is_dir():
            _copy(source / name, to / name, os.listdir(source / name))
        elif (source / name).exists():
            with atomic_file(to / name) as scratch:
                shutil.copyfile(source / name, scratch)


@dataclass(frozen=True)
class _Inputs:
    """What the first stage prepares, and all later ones need."""

    record: RunRecord
    out: Path
    config: Config
    shared: Path | None
    """As of `train_run`."""
    logged: EpisodeStore
    """The training episodes as they were logged."""
    held_out: EpisodeStore
    """The validation episodes as they were logged."""
    train: EpisodeStore
    """The training episodes as the policy sees them."""
    validation: EpisodeStore
    """The validation episodes as the policy sees them."""
    policy: SequencePolicy
    """Untrained, then trained in place."""


@random_state_kept()
def train_run(
    store: EpisodeStore,
    out: Path,
    config: Config,
    additions: Mapping[str, Any] | None = None,
    more_augmentation: AugmentedEpisodes | None = None,
    refit_of: Path | None = None,
    shared: Path | None = None,
    callbacks: Callbacks = SILENT,
    initial: Path | None = None,
) -> RunRecord:
    """Train a policy on the training episodes of `store`, or resume the run in `out`.

    The stages are those of Algorithm 1, then the choice of the decision rule; finished stages are
    not repeated. A run whose inputs are rejected leaves no folder.

    Where `torchrun` started several processes, they train the policy together; the leader does
    the rest, and the others return once the policy is trained.

    Args:
        out: run folder, new or interrupted.
        additions: entries of `RunRecord` that the caller adds.
        more_augmentation: augmented training episodes that are used in addition to the
            counterfactual ones.
        refit_of: a finished run whose weights go on learning, from the validation and test
            episodes too, with its augmented episodes; see `ucfrec.runs.refit`.
        shared: folder of reward models and augmentation that runs on the same store have in common
            where their settings of these stages and their seeds agree; by default a run makes its
            own. The time of a stage is in the record of the run that made it.
        initial: a run on an older state of the store, whose weights the training begins with, near
            whose rule a better one is looked for, and whose user model says which effects to fit.

    Raises:
        InputError: `out` is a run on another store or with another configuration, the store has
            too few training episodes or constant rewards, or the policy does not support its
            actions, or another process is training in `out`.
    """
    with lock_path(out, "trained") if distributed.leads() else nullcontext():
        if distributed.leads():
            remove_leftovers(out.parent)
            remove_leftovers(out, within=True)
        start = time.perf_counter()
        run = _prepare_inputs(store, out, config, additions or {}, refit_of, shared)
        if initial is not None:
            start_warm(run.policy, out, initial)
        with phase("Counterfactual augmentation", 1, 4):
            augmented, augmentation = _augment(run, refit_of)
        with phase("Training the policy", 2, 4):
            if (more := more_augmentation) is not None:
                augmented = more if augmented is None else augmented.join(more)
            first = refit_of and refit_of / "policy" / "best.safetensors"
            newest = None
            if run.record.update is not None:
                since = run.train.record.n_episodes - run.record.update.episodes
                newest = np.flatnonzero(run.train.episode_ids >= since)
            policy, train, held_out = run.policy, run.train, None if first else run.validation
            fit = fit_policy(
                policy, train, held_out, out, config, first, newest, callbacks, augmented
            )
        if not distributed.leads():
            return run.record
        chosen = run.record.rule is not None and run.record.policy == fit
        record = run.record.copy_with(augmentation=augmentation, policy=fit)
        if run.logged.has_items:
            rewards = run.logged.column(schema.REWARD)
            if not config.rule.choose or rewards.min() == rewards.max():
                if refit_of is None and record.ranking is None:
                    scorer = TrainedPolicy.load(out, in_training=True).scorer()
                    ranking = measure_ranking(scorer, run.logged, run.held_out, config.seed)
                    record = record.copy_with(ranking=ranking)
            elif not chosen:
                with phase("Fitting the user model", 3, 4):
                    users = _fit_user_model(run, initial)
                with phase("Selecting the decision rule", 4, 4):
                    rule = _choose_rule(run, users, initial)
                record = record.copy_with(reward_model=users.reward_report, rule=rule)
                del users  # what follows reads the reward model of the run
            if not (out / SAMPLES).exists():  # a resumed refit has the rule of its run by now
                scorer = TrainedPolicy.load(out, in_training=True).scorer()
                write_json(out / SAMPLES, sample_recommendations(scorer, run.held_out))
        seconds = record.wall_time_s + time.perf_counter() - start
        return record.copy_with(wall_time_s=seconds).seal(out)


def _prepare_inputs(
    store: EpisodeStore,
    out: Path,
    config: Config,
    additions: Mapping[str, Any],
    refit_of: Path | None,
    shared: Path | None,
) -> _Inputs:
    """Check all inputs and begin the run, or reopen it."""
    train, validation = logged, held_out = training_views(store)
    if refit_of is not None:
        train = logged = store
    if distributed.leads():
        require_startable(store, train, out, config)
        note_ignored(config.policy_name)
    policy = new_policy(train, config)
    if distributed.leads():
        if not (out / RUN).exists():
            begin(store, train, validation, out, config, additions)
        record = RunRecord.read(out).reopen(out, INPUTS)
        distributed.wait()  # the others wait at the beginning of the command
    else:
        record = RunRecord.read(out)
    # The store may have been moved, or prepared again.
    place = {name: additions.get(name, at) for name, at in place_of(store.path, out).items()}
    record = record.copy_with(config=config, **place)
    with distributed.leader_first():
        view = policy.training_view(train, config.policy, out / "view", config.seed)
    if not record.return_to_go.per_session:
        held_out = continue_users(held_out, logged)
        view, validation = (
            episodes.with_return_to_go(record.return_to_go) for episodes in (view, held_out)
        )
    if view is not train:
        policy = new_policy(view, config)
    policy = policy.to("cuda" if torch.cuda.is_available() else "cpu")
    return _Inputs(record, out, config, shared, logged, held_out, view, validation, policy)


def _augment(
    run: _Inputs, refit_of: Path | None
) -> tuple[AugmentedEpisodes | None, AugmentationReport | None]:
    """Causal reward model, generator and gate (lines 1 to 3 of Algorithm 1), made once."""
    config, out, device = run.config, run.out, run.policy.state_mean.device
    if not config.augment.augments:
        return None, run.record.augmentation
    if refit_of is not None:
        return AugmentedEpisodes.load(refit_of / AUGMENTED), run.record.augmentation
    crm, csg, augment = config.crm, config.csg, config.augment
    # A policy's own view of the episodes has augmentation of its own.
    has_own_view = run.train is not run.logged
    shared = None if has_own_view or not run.record.return_to_go.per_session else run.shared

    def make() -> None:
        augmented, report = augment_episodes(
            run.train, run.validation, crm, csg, augment, out, config.seed, device
        )
        augmented.save(out / AUGMENTED)
        write_json(out / AUGMENTATION, asdict(report))

    with distributed.leader_first():
        if not (out / AUGMENTATION).exists():
            inputs = _dependencies(run.train, run.validation, config.seed, device)
            inputs["settings"] = [asdict(table) for table in (crm, csg, augment)]
            files = (*MODELS, AUGMENTED, AUGMENTATION)
            share_stage(shared, inputs, augment_episodes.__module__, out, files, make)
        augmented = AugmentedEpisodes.load(out / AUGMENTED)
        return augmented, read_augmentation(out / AUGMENTATION)


def _fit_user_model(run: _Inputs, initial: Path | None) -> UserModel:
    """Fit what users would do: the reward of every item, session ends and fatigue."""
    train, validation = run.logged.without_long_sessions(), run.held_out.without_long_sessions()
    simulated, folder = run.record.return_to_go.per_session, run.out / REWARD_MODEL
    inputs = _dependencies(train, validation, run.config.seed, torch.device("cpu"))
    inputs |= {"settings": [], "simulated": simulated}
    first = None if initial is None else initial / REWARD_MODEL
    fit = partial(UserModel.fit, train, validation, folder, run.config.seed, simulated, first)
    share_stage(run.shared, inputs, UserModel.__module__, run.out, (REWARD_MODEL,), fit)
    return fit()  # read from the folder


def _choose_rule(run: _Inputs, users: UserModel, initial: Path | None) -> RuleRecord:
    """Choose the decision rule: in simulated sessions, or where the log has none, by ranking."""
    states, returns, config = run.logged.item_states, run.record.return_to_go, run.config.rule
    # What `TrainedPolicy.load` reads, but for a second policy and a second table of items.
    values, _ = load_tensors(run.out / RETURNS)
    rule = read_rule(run.out / RULE)
    no_users = np.zeros(0, dtype=np.int64)
    trained = TrainedPolicy(
        run.out, run.policy, run.record, states, None, no_users, values["returns"].numpy(), rule
    )
    problem = Problem(
        Scorer(run.policy, rule, states, returns, users.reward, users.session_end),
        users,
        {quantile: trained.target_return(quantile) for quantile in config.quantiles},
        run.logged.without_long_sessions(),
        run.held_out.without_long_sessions(),
        config,
        run.config.seed,
        None if initial is None else rule_to_start_from(initial, trained),
    )
    choose = choose_by_simulation if returns.per_session else choose_by_ranking
    chosen, candidates = choose(problem)
    write_json(run.out / RULE, chosen.rule.as_dict())
    entries = [{**asdict(entry), "rule": entry.rule.as_dict()} for entry in candidates]
    write_json(run.out / CANDIDATES, entries)
    return chosen


def _dependencies(
    train: EpisodeStore,
    validation: EpisodeStore,
    seed: int,
    device: torch.device,
) -> dict[str, Any]:
    """All that a reward model or copies depend on, but for their settings."""
    return {
        "data": train.record.fingerprint,
        "item_states": train.record.files.get(ITEM_STATES),
        "steps": [train.n_steps, validation.n_steps],
        "state_size": train.state_size,
        "seed": seed,
        "device": device.type,
    }


@torch.no_grad()
def sample_recommendations(scorer: Scorer, validation: EpisodeStore) -> dict[str, Any]:
    """Recommendations of a policy of items at the last step of a few validation sessions.

    Returns:
        A JSON object: the `rule` in words, and `sessions` with up to 5 items before the last step
        (`history`), their `rewards`, the item `logged` at the last step and the 5 items
        `recommended`, best first. Items are row numbers of `items.parquet`.
    """
    long_enough = np.flatnonzero(validation.lengths >= min(2, validation.lengths.max()))
    places = np.linspace(0, len(long_enough) - 1, min(_SESSIONS, len(long_enough)))
    episodes = long_enough[places.astype(np.int64)]
    last = validation.lengths[episodes] - 1
    scores = logged_scores(scorer, validation, episodes, last)
    best = best_items(scores, min(_ITEMS, scores.shape[1]))
    sessions = []
    for place in range(len(episodes)):
        session = validation.select(episodes[[place]])
        items, rewards = session.column(schema.ITEM), session.column(schema.REWARD)
        sessions.append(
            {
                "history": items[:-1][-_HISTORY:].tolist(),
                "rewards": rewards[:-1][-_HISTORY:].tolist(),
                "logged": int(items[-1]),
                "recommended": best[place].tolist(),
            }
        )
    return {"rule": str(scorer.rule), "sessions": sessions}
