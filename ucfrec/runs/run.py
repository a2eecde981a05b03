"""Train a policy (Algorithm 1) and keep everything it produces in a run folder."""

import dataclasses
import shutil
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ucfrec import schema
from ucfrec.acting.decision import Decider, DecisionRule
from ucfrec.arrays import Float32Array
from ucfrec.choosing.choose import choose_rule
from ucfrec.counterfactual.augmentation import (
    MODELS,
    counterfactual_augmentation,
    require_rewards_vary,
)
from ucfrec.counterfactual.generators import CSGConfig
from ucfrec.counterfactual.reward_model import CRMConfig
from ucfrec.counterfactual.state_augmentation import AugmentConfig
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.episodes.windows import Overlay
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder, read_json, write_json
from ucfrec.files.checksums import FILES, reopen, seal
from ucfrec.files.locks import claimed, remove_leftovers, remove_leftovers_within
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import save_tensors
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import command_line, versions
from ucfrec.runs.config import Config, config_from_dict
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.record import is_of_store
from ucfrec.runs.reference_losses import reference_losses
from ucfrec.runs.samples import SAMPLES, sample_recommendations
from ucfrec.runs.shared_stages import OWN, SharedStages
from ucfrec.runs.trained_policy import (
    AUGMENTATION,
    COUNTS,
    INPUTS,
    ITEMS,
    RETURNS,
    REWARD_MODEL,
    RULE,
    RUN,
    USERS,
    TrainedPolicy,
    store_from,
)
from ucfrec.user_model.model import UserModel
from ucfrec.user_model.reward_fit import reward_model_sizes

_MOST_RETURNS = 1_000_001
_QUANTILES = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
_OVERLAY = "overlay.safetensors"


@random_state_kept()
def train_run(
    store: EpisodeStore,
    out: Path,
    config: Config,
    about: Mapping[str, Any] | None = None,
    more_copies: Overlay | None = None,
    on_all_rows: bool = False,
    shared: SharedStages = OWN,
) -> dict[str, Any]:
    """Train a policy on the training episodes of `store`, or resume the run in `out`.

    The stages are reward model, generator and copies (unless `augment` makes none), then the
    policy; finished stages are not repeated. `out` is created after all inputs have been checked,
    so that a rejected run leaves no folder. The global random state is restored on return.

    Where `torchrun` started several processes, they train the policy together; the leader does
    the rest, and the others return once the policy is trained.

    Args:
        store: prepared episodes.
        out: run folder, new or interrupted.
        config: configuration of all stages.
        about: entries that a dataset adapter adds to the record.
        more_copies: a dataset adapter's edited copies of training episodes, used in addition to
            the counterfactual ones.
        on_all_rows: train on the validation and test episodes too, and keep the last weights; see
            `ucfrec.runs.refit`.
        shared: reward models and copies that runs on the same store have in common where their
            settings of these stages and their seeds agree; by default a run makes its own. The
            time of a stage is in the record of the run that made it.

    Returns:
        The content of `run.json`: provenance, configuration and the report of every stage.

    Raises:
        InputError: `out` is a run on another store or with another configuration, the store has
            too few training episodes or constant rewards, or the learner does not support its
            actions, or another process is training in `out`.
    """
    if not distributed.leads():
        return _train(store, out, config, about, more_copies, on_all_rows, shared)
    with claimed(out, "trained"):
        remove_leftovers(out.parent)
        remove_leftovers_within(out)
        return _train(store, out, config, about, more_copies, on_all_rows, shared)


def _train(
    store: EpisodeStore,
    out: Path,
    config: Config,
    about: Mapping[str, Any] | None,
    more_copies: Overlay | None,
    on_all_rows: bool,
    shared: SharedStages,
) -> dict[str, Any]:
    """`train_run` of a run that no other process trains."""
    train, validation = logged, held_out = training_views(store)
    if on_all_rows:
        train = logged = store
    if distributed.leads():
        _require_startable(store, train, out, config)
    policy = new_policy(train, config)
    if distributed.leads():
        if not (out / RUN).exists():
            _begin(store, train, validation, out, config, about or {})
        reopen(out, RUN, read_json(out / RUN), INPUTS)
        distributed.wait()  # the others wait at the beginning of the command
    record: dict[str, Any] = read_json(out / RUN)
    record["config"] = dataclasses.asdict(config)
    start = time.perf_counter() - record["wall_time_s"]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    with distributed.leader_first():
        view = policy.training_view(train, config.policy, out / "view", config.seed)
    returns = ReturnToGo(**record["return_to_go"])
    if not returns.per_session:
        view, validation = (each.with_return_to_go(returns) for each in (view, validation))
    if view is not train:
        train, policy = view, new_policy(view, config)
    policy = policy.to(device)
    if config.augment.augments:
        with distributed.leader_first():
            overlay, record["augmentation"] = _counterfactuals(
                *(train, validation, out, config, device),
                # A learner's own view of the episodes has copies of its own.
                shared if view is logged and returns.per_session else OWN,
            )
        more_copies = overlay if more_copies is None else overlay.joined(more_copies)
    if more_copies is not None:
        train = train.with_overlay(more_copies)
    fitted = fit_policy(policy, train, None if on_all_rows else validation, out, config)
    if not distributed.leads():
        return record
    chosen = "rule" in record and record.get("policy") == dataclasses.asdict(fitted)
    record["policy"] = dataclasses.asdict(fitted)
    if logged.has_items and config.rule.choose and not chosen:
        record["reward_model"], record["rule"] = _rule(
            policy, logged, held_out, out, config, shared
        )
    record["wall_time_s"] = time.perf_counter() - start
    _write_samples(out, held_out)
    return seal(out, RUN, record)


def _require_startable(store: EpisodeStore, train: EpisodeStore, out: Path, config: Config) -> None:
    if (out / RUN).exists():
        _require_same(read_json(out / RUN), store, out, config)
    elif config.augment.augments:
        require_rewards_vary(train)


def training_views(store: EpisodeStore) -> tuple[EpisodeStore, EpisodeStore]:
    """The training and the validation episodes of a store.

    Without a validation split, every tenth training episode is held out for validation.

    Raises:
        InputError: the store has fewer than 2 training episodes.
    """
    train, validation = store.split("train"), store.split("validation")
    if train.n_episodes < 2:
        raise InputError(
            f"{store.path} has {train.n_episodes} training episodes, at least 2 are needed; "
            "prepare it with a larger training share"
        )
    if validation.n_episodes:
        return train, validation
    held_out = np.arange(train.n_episodes) % 10 == 1
    return train.select(np.flatnonzero(~held_out)), train.select(np.flatnonzero(held_out))


def _begin(
    store: EpisodeStore,
    train: EpisodeStore,
    validation: EpisodeStore,
    out: Path,
    config: Config,
    about: Mapping[str, Any],
) -> None:
    record = {
        "command": command_line(),
        "config": dataclasses.asdict(config),
        "seed": config.seed,
        "store": str(store.path.resolve()),
        "store_from_run": store_from(out, store.path),
        "fingerprint": store.meta["fingerprint"],
        "reward": store.meta["reward"],
        "session_by": store.meta["source"].get("session_by"),
        "session_gap_ms": store.meta["source"].get("session_gap_ms"),
        "sizes": _sizes(store),
        "observation_size": store.observation_size,
        "train_episodes": train.n_episodes,
        "train_steps": train.n_steps,
        "return_to_go": dataclasses.asdict(_returns(store, config)),
        "return_quantiles": {str(q): float(np.quantile(train.returns, q)) for q in _QUANTILES},
        "mean_return": float(train.returns.mean()),
        "data": store.meta["source"],
        "versions": versions(),
        "wall_time_s": 0.0,
        **about,
    }
    returns = _target_returns(train, _returns(store, config))
    with atomic_folder(out) as scratch:
        save_tensors(scratch / RETURNS, {"returns": torch.from_numpy(returns)}, {})
        target = float(np.quantile(returns.astype(np.float64), config.rule.default_quantile))
        rule = DecisionRule(target, tag_window=config.rule.default_tag_window)
        write_json(scratch / RULE, rule.as_dict())
        for name in (ITEM_STATES, ITEMS, USERS):
            if (store.path / name).exists():
                shutil.copyfile(store.path / name, scratch / name)
        if store.has_items:
            counts = TrainingCounts.of(train)
            counts.save(scratch / COUNTS)
            record["reference_losses"] = reference_losses(counts, validation)
        seal(scratch, RUN, record)


def _returns(store: EpisodeStore, config: Config) -> ReturnToGo:
    return config.policy.returns(store.meta["source"].get("session_by"))


def _target_returns(train: EpisodeStore, definition: ReturnToGo) -> Float32Array:
    """Sorted returns-to-go of sessions, or of steps if targets are set anew at every step.

    Of more than a million, evenly spaced order statistics are kept, the lowest and highest too.
    """
    returns = train.returns
    if not definition.per_session:
        returns = train.with_return_to_go(definition).column(schema.RETURN_TO_GO)
    kept = np.linspace(0, len(returns) - 1, min(len(returns), _MOST_RETURNS)).astype(np.int64)
    return np.asarray(np.sort(returns)[kept], dtype=np.float32)


def _require_same(
    record: Mapping[str, Any], store: EpisodeStore, out: Path, config: Config
) -> None:
    if not is_of_store(record, store.meta):
        raise InputError(
            f"{out} is a run on another store ({record['store']}, fingerprint "
            f"{record['fingerprint'][:12]}), not on {store.path} "
            f"({store.meta['fingerprint'][:12]}), or on other item states than that has; name "
            "another run folder"
        )
    started = config_from_dict(record["config"])
    if not config.train.cosine and config.train.steps > started.train.steps:
        # Without a cosine schedule, a run may be resumed with more steps.
        longer = dataclasses.replace(started.train, steps=config.train.steps)
        started = dataclasses.replace(started, train=longer)
    before, now = dataclasses.asdict(started), dataclasses.asdict(config)
    for table, values in now.items():
        if before[table] != values:
            difference = _difference(before[table], values)
            raise InputError(
                f"{out} was started with another {table} ({difference}); name another run folder, "
                "or give the same configuration to resume"
            )


def _difference(before: Any, now: Any) -> str:
    if not isinstance(now, Mapping):
        return f"{before} in the run, {now} now"
    return ", ".join(
        f"{key} is {before.get(key)} in the run, {value} now"
        for key, value in now.items()
        if before.get(key) != value
    )


def _counterfactuals(
    train: EpisodeStore,
    validation: EpisodeStore,
    out: Path,
    config: Config,
    device: torch.device,
    shared: SharedStages,
) -> tuple[Overlay, dict[str, Any]]:
    """The copies of a run and their report; made once, then read from `out`."""
    settings = (config.crm, config.csg, config.augment)

    def make() -> None:
        overlay, report = counterfactual_augmentation(
            train, validation, *settings, out, config.seed, device
        )
        overlay.save(out / _OVERLAY)
        write_json(out / AUGMENTATION, dataclasses.asdict(report))

    if not (out / AUGMENTATION).exists():
        inputs = _inputs(train, validation, config.seed, device, *settings)
        module = counterfactual_augmentation.__module__
        shared.provide(inputs, module, out, (*MODELS, _OVERLAY, AUGMENTATION), make)
    return Overlay.load(out / _OVERLAY), read_json(out / AUGMENTATION)


def _inputs(
    train: EpisodeStore,
    validation: EpisodeStore,
    seed: int,
    device: torch.device,
    *settings: CRMConfig | CSGConfig | AugmentConfig,
) -> dict[str, Any]:
    """All that a reward model or copies depend on, but the code."""
    return {
        "data": train.meta["fingerprint"],
        "item_states": train.meta.get(FILES, {}).get(ITEM_STATES),
        "steps": [train.n_steps, validation.n_steps],
        "state_size": train.state_size,
        "seed": seed,
        "device": device.type,
        "settings": [dataclasses.asdict(table) for table in settings],
    }


def _sizes(store: EpisodeStore) -> dict[str, int]:
    columns = store.meta["columns"]
    if store.has_items:
        return reward_model_sizes(store)
    return {"state": store.state_size, "action": columns[schema.ACTION][0], "items": 0}


@random_state_kept()
def new_policy(train: EpisodeStore, config: Config) -> SequencePolicy:
    """An untrained policy with the normalisation and item embeddings of `train`."""
    torch.manual_seed(config.seed)
    policy = policy_class(config.policy_name)(config.policy, _sizes(train))
    base = train.without_copies()
    mean, std = base.state_statistics
    policy.state_mean.copy_(mean)
    policy.state_std.copy_(torch.where(std > 1e-6, std, 1.0))
    scale = config.policy.return_scale or float(np.abs(base.returns).max()) or 1.0
    returns_to_go = base.column(schema.RETURN_TO_GO)
    if not _returns(base, config).per_session and not config.policy.return_scale:
        scale = float(np.abs(returns_to_go).max()) or 1.0
    policy.return_scale.fill_(scale)
    policy.lowest_return_to_go.fill_(float(returns_to_go.min()))
    if isinstance(policy.head, ItemHead):
        counts = torch.from_numpy(base.item_counts()).float()
        policy.head.start_from(base.item_states.embeddings, counts)
        if policy.head.exposure is not None:
            scaled = torch.from_numpy(returns_to_go) / policy.return_scale
            policy.head.exposure.start_from(base.item_states, scaled)
    else:
        actions = base.column(schema.ACTION)
        policy.head.scale.copy_(torch.from_numpy(np.abs(actions).max(0)).clamp(min=1.0))
    policy.start_from(base)
    return policy


def _rule(
    policy: SequencePolicy,
    train: EpisodeStore,
    validation: EpisodeStore,
    out: Path,
    config: Config,
    shared: SharedStages,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fit the user model and choose the rule; returns the reports of both."""
    fit = partial(UserModel.fit, train, validation, out / REWARD_MODEL, config.seed)
    inputs = _inputs(train, validation, config.seed, torch.device("cpu"))
    shared.provide(inputs, UserModel.__module__, out, (REWARD_MODEL,), fit)
    users = fit()  # read from the folder
    trained = TrainedPolicy.load(out, in_training=True)
    targets = {quantile: trained.target_return(quantile) for quantile in config.rule.quantiles}
    decider = Decider(policy, trained.rule, trained.returns, users.reward)
    choice = choose_rule(decider, users, targets, train, validation, config.rule, config.seed)
    write_json(out / RULE, choice.rule.as_dict())
    return dataclasses.asdict(users.reward_report), choice.as_dict()


def _write_samples(out: Path, validation: EpisodeStore) -> None:
    """Save a few recommendations for the report, by the run's decision rule."""
    if validation.has_items:
        trained = TrainedPolicy.load(out, in_training=True)
        write_json(out / SAMPLES, sample_recommendations(trained.decider(), validation))
