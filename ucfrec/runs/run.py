"""Train a policy (Algorithm 1) and keep everything it produces in a run folder."""

import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import IntArray
from ucfrec.choosing.by_ranking import choose_by_ranking
from ucfrec.choosing.by_simulation import choose_by_simulation
from ucfrec.choosing.choice import Problem
from ucfrec.counterfactual.augmentation import (
    MODELS,
    AugmentationReport,
    AugmentConfig,
    augment_episodes,
)
from ucfrec.counterfactual.generators import CSGConfig
from ucfrec.counterfactual.reward_model import CRMConfig
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.episodes.windows import AUGMENTED, AugmentedEpisodes
from ucfrec.files.atomic import write_json
from ucfrec.files.locks import lock_path, remove_leftovers, remove_leftovers_within
from ucfrec.fitting import distributed
from ucfrec.fitting.loop import SILENT, Callbacks, Fit
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import note_ignored
from ucfrec.processes import random_state_kept
from ucfrec.progress import phase
from ucfrec.runs.config import Config
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.record import (
    CANDIDATES,
    RUN,
    RuleRecord,
    RunRecord,
    place_of,
    read_augmentation,
    read_record,
)
from ucfrec.runs.samples import SAMPLES, sample_recommendations
from ucfrec.runs.shared_stages import OWN, SharedStages
from ucfrec.runs.start import (
    begin,
    new_policy,
    require_startable,
    training_views,
)
from ucfrec.runs.trained_policy import AUGMENTATION, INPUTS, REWARD_MODEL, RULE, TrainedPolicy
from ucfrec.runs.warm_start import rule_to_start_from, start_warm
from ucfrec.user_model.model import UserModel

PHASES = 4
"""Phases of a training that have progress of their own."""


@dataclass(frozen=True)
class _Inputs:
    """What the first stage prepares, and all later ones need."""

    record: RunRecord
    out: Path
    config: Config
    shared: SharedStages
    device: torch.device
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
    about: Mapping[str, Any] | None = None,
    more_augmentation: AugmentedEpisodes | None = None,
    refit_of: Path | None = None,
    shared: SharedStages = OWN,
    callbacks: Callbacks = SILENT,
    initial: Path | None = None,
) -> RunRecord:
    """Train a policy on the training episodes of `store`, or resume the run in `out`.

    The stages are those of Algorithm 1, then the choice of the decision rule; finished stages are
    not repeated. `out` is created after all inputs have been checked, so that a rejected run leaves
    no folder. The global random state is restored on return.

    Where `torchrun` started several processes, they train the policy together; the leader does
    the rest, and the others return once the policy is trained.

    Args:
        out: run folder, new or interrupted.
        about: entries of `RunRecord` that the caller adds.
        more_augmentation: augmented training episodes that are used in addition to the
            counterfactual ones.
        refit_of: a finished run whose weights go on learning, from the validation and test
            episodes too, with its augmented episodes; see `ucfrec.runs.refit`.
        shared: reward models and augmentation that runs on the same store have in common where
            their settings of these stages and their seeds agree; by default a run makes its own.
            The time of a stage is in the record of the run that made it.
        callbacks: what is told of the training of the policy.
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
            remove_leftovers_within(out)
        start = time.perf_counter()
        run = _prepare_inputs(store, out, config, about or {}, refit_of, shared)
        if initial is not None:
            start_warm(run.policy, out, initial)
        with phase("Counterfactual augmentation", 1, PHASES):
            augmented, augmentation = _augment(run, refit_of)
        with phase("Training the policy", 2, PHASES):
            fit = _train_policy(run, augmented, more_augmentation, refit_of, callbacks)
        if not distributed.leads():
            return run.record
        chosen = run.record.rule is not None and run.record.policy == fit
        record = run.record.copy_with(augmentation=augmentation, policy=fit)
        if run.logged.has_items and config.rule.choose and not chosen:
            record = record.copy_with(**_selected(run, initial))
        _write_samples(run)
        seconds = record.wall_time_s + time.perf_counter() - start
        return record.copy_with(wall_time_s=seconds).seal(out)


def _selected(run: _Inputs, initial: Path | None) -> dict[str, Any]:
    """Entries of the record: the user model and the decision rule that is best in it."""
    with phase("Fitting the user model", 3, PHASES):
        user_model = _fit_user_model(run, initial)
    with phase("Selecting the decision rule", 4, PHASES):
        rule = _choose_rule(run, user_model, initial)
    return {"reward_model": user_model.reward_report, "rule": rule}


def _prepare_inputs(
    store: EpisodeStore,
    out: Path,
    config: Config,
    about: Mapping[str, Any],
    refit_of: Path | None,
    shared: SharedStages,
) -> _Inputs:
    """Check all inputs and begin the run or reopen it; views of the episodes, untrained policy."""
    train, validation = logged, held_out = training_views(store)
    if refit_of is not None:
        train = logged = store
    if distributed.leads():
        require_startable(store, train, out, config)
        note_ignored(config.policy_name)
    policy = new_policy(train, config)
    if distributed.leads():
        if not (out / RUN).exists():
            begin(store, train, validation, out, config, about)
        record = RunRecord.read(out).reopen(out, INPUTS)
        distributed.wait()  # the others wait at the beginning of the command
    else:
        record = RunRecord.read(out)
    # The store may have been moved, or prepared again.
    place = {name: about.get(name, at) for name, at in place_of(store.path, out).items()}
    record = record.copy_with(config=config, **place)
    with distributed.leader_first():
        view = policy.training_view(train, config.policy, out / "view", config.seed)
    if not record.return_to_go.per_session:
        view, validation = (
            episodes.with_return_to_go(record.return_to_go) for episodes in (view, validation)
        )
    if view is not train:
        policy = new_policy(view, config)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return _Inputs(
        *(record, out, config, shared, device),
        *(logged, held_out, view, validation, policy.to(device)),
    )


def _augment(
    run: _Inputs, refit_of: Path | None
) -> tuple[AugmentedEpisodes | None, AugmentationReport | None]:
    """Causal reward model, generator and acceptance gate (lines 1 to 3 of Algorithm 1).

    Made once, then read from the run folder, or from that of the run that is refitted; (None, None)
    for a run without augmentation.
    """
    config, out = run.config, run.out
    if refit_of is not None:
        if not config.augment.augments:
            return None, run.record.augmentation
        return AugmentedEpisodes.load(refit_of / AUGMENTED, run.train), run.record.augmentation
    if not config.augment.augments:
        return None, run.record.augmentation
    settings = (config.crm, config.csg, config.augment)
    # A policy's own view of the episodes has augmentation of its own.
    has_own_view = run.train is not run.logged
    shared = OWN if has_own_view or not run.record.return_to_go.per_session else run.shared

    def make() -> None:
        augmented, report = augment_episodes(
            run.train, run.validation, *settings, out, config.seed, run.device
        )
        augmented.save(out / AUGMENTED)
        write_json(out / AUGMENTATION, asdict(report))

    with distributed.leader_first():
        if not (out / AUGMENTATION).exists():
            inputs = _dependencies(run.train, run.validation, config.seed, run.device, *settings)
            files = (*MODELS, AUGMENTED, AUGMENTATION)
            shared.provide(inputs, augment_episodes.__module__, out, files, make)
        augmented = AugmentedEpisodes.load(out / AUGMENTED, run.train)
        return augmented, read_augmentation(out / AUGMENTATION)


def _train_policy(
    run: _Inputs,
    augmented: AugmentedEpisodes | None,
    more: AugmentedEpisodes | None,
    refit_of: Path | None,
    callbacks: Callbacks,
) -> Fit:
    """Fit the policy to logged and augmented episodes (lines 4 and following of Algorithm 1)."""
    if more is not None:
        augmented = more if augmented is None else augmented.join(more)
    start = None if refit_of is None else refit_of / "policy" / "best.safetensors"
    validation = run.validation if refit_of is None else None
    newest = _newest(run.record if refit_of is None else read_record(refit_of), run.train)
    given = run.policy, run.train, validation, run.out, run.config, start, newest, callbacks
    return fit_policy(*given, augmented)


def _newest(record: RunRecord, train: EpisodeStore) -> IntArray | None:
    """Positions among the training episodes of those that an update added; None for none."""
    if record.update is None:
        return None
    first = train.record.n_episodes - record.update.episodes
    return np.flatnonzero(train.episode_ids >= first)


def _fit_user_model(run: _Inputs, initial: Path | None) -> UserModel:
    """Fit what users would do: the reward of every item, session ends and fatigue."""
    views = run.logged.without_long_sessions(), run.held_out.without_long_sessions()
    inputs = _dependencies(*views, run.config.seed, torch.device("cpu"))
    inputs["simulated"] = simulated = run.record.return_to_go.per_session
    inputs_of_fit = *views, run.out / REWARD_MODEL, run.config.seed
    first = None if initial is None else initial / REWARD_MODEL
    fit = partial(UserModel.fit, *inputs_of_fit, simulated, first)
    run.shared.provide(inputs, UserModel.__module__, run.out, (REWARD_MODEL,), fit)
    return fit()  # read from the folder


def _choose_rule(run: _Inputs, users: UserModel, initial: Path | None) -> RuleRecord:
    """Choose the decision rule: in simulated sessions, or where the log has none, by ranking."""
    trained = TrainedPolicy.load(run.out, in_training=True)
    parts = trained.item_states, trained.returns, users.reward, users.session_end
    scorer = Scorer(run.policy, trained.rule, *parts)
    config = run.config.rule
    targets = {quantile: trained.target_return(quantile) for quantile in config.quantiles}
    views = run.logged.without_long_sessions(), run.held_out.without_long_sessions()
    start = None if initial is None else rule_to_start_from(initial, trained)
    problem = targets, *views, config, run.config.seed, start
    choose = choose_by_simulation if trained.returns.per_session else choose_by_ranking
    choice = choose(Problem(scorer, users, *problem))
    write_json(run.out / RULE, choice.rule.as_dict())
    write_json(run.out / CANDIDATES, choice.list_candidates())
    return RuleRecord.model_validate(choice.as_dict())


def _write_samples(run: _Inputs) -> None:
    """Save a few recommendations for the report, by the run's decision rule."""
    if run.held_out.has_items:
        trained = TrainedPolicy.load(run.out, in_training=True)
        write_json(run.out / SAMPLES, sample_recommendations(trained.scorer(), run.held_out))


def _dependencies(
    train: EpisodeStore,
    validation: EpisodeStore,
    seed: int,
    device: torch.device,
    *settings: CRMConfig | CSGConfig | AugmentConfig,
) -> dict[str, Any]:
    """All that a reward model or copies depend on."""
    return {
        "data": train.record.fingerprint,
        "item_states": train.record.files.get(ITEM_STATES),
        "steps": [train.n_steps, validation.n_steps],
        "state_size": train.state_size,
        "seed": seed,
        "device": device.type,
        "settings": [asdict(table) for table in settings],
    }
