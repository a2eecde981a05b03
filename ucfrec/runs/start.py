"""The beginning of a run: its training and validation episodes, its record, an untrained policy."""

import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Float32Array
from ucfrec.counterfactual.augmentation import require_rewards_vary
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import TrainingCounts
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder, write_json
from ucfrec.fitting.checkpoint import save_tensors
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.registry import policy_class, policy_package
from ucfrec.processes import random_state_kept
from ucfrec.provenance import command_line, versions
from ucfrec.runs.config import Config
from ucfrec.runs.record import RUN, RunRecord, place_of
from ucfrec.runs.trained_policy import COUNTS, ITEMS, RETURNS, RULE, USERS
from ucfrec.user_model.reward_fit import reward_model_sizes

_MOST_RETURNS = 1_000_001
_QUANTILES = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)


def training_views(store: EpisodeStore) -> tuple[EpisodeStore, EpisodeStore]:
    """The training and the validation episodes of a store.

    Without a validation split, every tenth training episode is held out for validation.

    Raises:
        InputError: the store has fewer than 2 training episodes.
    """
    train, validation = store.split("train"), store.split("validation")
    if train.n_episodes < 2:
        episodes = "1 training episode" if train.n_episodes else "no training episodes"
        raise InputError(
            f"{store.path} has {episodes}, at least 2 are needed; collect more data, or prepare "
            "the store so that fewer episodes are held out"
        )
    if validation.n_episodes:
        return train, validation
    held_out = np.arange(train.n_episodes) % 10 == 1
    return train.select(np.flatnonzero(~held_out)), train.select(np.flatnonzero(held_out))


def require_startable(store: EpisodeStore, train: EpisodeStore, out: Path, config: Config) -> None:
    """Check that a run can begin, or go on, in the folder `out`.

    Raises:
        InputError: `out` is a run on another store or with another configuration; or the rewards
            never vary, which augmentation needs.
    """
    if (out / RUN).exists():
        _require_same(RunRecord.read(out), store, out, config)
    elif config.augment.augments:
        require_rewards_vary(train)


def _require_same(record: RunRecord, store: EpisodeStore, out: Path, config: Config) -> None:
    if not record.is_of(store.record):
        raise InputError(
            f"{out} is a run on another store ({record.store}, fingerprint "
            f"{record.fingerprint[:12]}), not on {store.path} "
            f"({store.record.fingerprint[:12]}), or on other item states than that has; name "
            "another run folder"
        )
    started = record.config
    if not config.train.cosine and config.train.steps > started.train.steps:
        # Without a cosine schedule, a run may be resumed with more steps.
        started = replace(started, train=replace(started.train, steps=config.train.steps))
    before, now = asdict(started), asdict(config)
    for table, values in now.items():
        if before[table] != values:
            difference = _difference(before[table], values)
            raise InputError(
                f"{out} was started with another {table} ({difference}); name another run folder, "
                "or give the same configuration to resume"
            )


def _difference(started_settings: Any, now: Any) -> str:
    if not isinstance(now, Mapping):
        return f"{started_settings} in the run, {now} now"
    return ", ".join(
        f"{key} is {started_settings.get(key)} in the run, {value} now"
        for key, value in now.items()
        if started_settings.get(key) != value
    )


def begin(
    store: EpisodeStore,
    train: EpisodeStore,
    validation: EpisodeStore,
    out: Path,
    config: Config,
    about: Mapping[str, Any],
) -> None:
    """Write the folder of a run with its record and all that training does not change.

    Args:
        store: the whole store.
        validation: held-out episodes.
    """
    returns_to_go, source = returns_of(store, config), store.record.source
    package = policy_package(config.policy_name)
    entries: dict[str, Any] = {
        "files": {},
        "command": command_line(),
        "config": config,
        "seed": config.seed,
        **place_of(store.path, out),
        "fingerprint": store.record.fingerprint,
        "reward": store.record.reward,
        "session_by": source.session_by,
        "session_gap_ms": source.session_gap_ms,
        "sizes": policy_sizes(store),
        "observation_size": store.observation_size,
        "train_episodes": train.n_episodes,
        "train_steps": train.n_steps,
        "return_to_go": returns_to_go,
        "return_quantiles": {str(q): float(np.quantile(train.returns, q)) for q in _QUANTILES},
        "mean_return": float(train.returns.mean()),
        "data": source,
        "versions": versions([package] if package else []),
        "policy_package": package or None,
        "wall_time_s": 0.0,
        **about,
    }
    returns = _target_returns(train, returns_to_go)
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
            entries["reference_losses"] = reference_losses(counts, validation)
        RunRecord.of(entries, out / RUN).seal(scratch)


def returns_of(store: EpisodeStore, config: Config) -> ReturnToGo:
    """What the returns-to-go of a run on `store` count."""
    return config.policy.returns(store.record.source.session_by)


def _target_returns(train: EpisodeStore, definition: ReturnToGo) -> Float32Array:
    """Sorted returns-to-go of sessions, or of steps if targets are set again at every step.

    Sessions as long as only those of bots are count for nothing. Of more than a million, evenly
    spaced order statistics are kept, the lowest and highest too.
    """
    if train.has_items:
        train = train.without_long_sessions()
    returns = train.returns
    if not definition.per_session:
        returns = train.with_return_to_go(definition).column(schema.RETURN_TO_GO)
    places = np.linspace(0, len(returns) - 1, min(len(returns), _MOST_RETURNS)).astype(np.int64)
    return np.asarray(np.sort(returns)[places], dtype=np.float32)


def reference_losses(counts: TrainingCounts, validation: EpisodeStore) -> dict[str, float]:
    """Mean negative log-likelihood (nats) of the logged items over all validation steps.

    Args:
        validation: validation episodes, at least one.

    Returns:
        `uniform`: the loss if all items are equally probable. `popularity`: the loss if an item's
        probability is its share of the training steps with one added to every count, which is how
        the bias of `ItemHead` is initialised.
    """
    items = torch.from_numpy(validation.column(schema.ITEM)).long()
    smoothed = counts.shown + 1
    log_shares = torch.log(smoothed / smoothed.sum())
    return {
        "uniform": math.log(len(counts.shown)),
        "popularity": -float(log_shares[items].double().mean()),
    }


def policy_sizes(store: EpisodeStore) -> dict[str, int]:
    """Sizes of states and actions, and of the catalogue (0 for vectors), that policies have."""
    if store.has_items:
        return reward_model_sizes(store)
    return {
        "state": store.state_size,
        "action": store.record.columns[schema.ACTION][0],
        "items": 0,
    }


@random_state_kept()
def new_policy(train: EpisodeStore, config: Config) -> SequencePolicy:
    """An untrained policy with the normalisation and item embeddings of `train`.

    Raises:
        InputError: the policy does not support the actions of `train`.
    """
    torch.manual_seed(config.seed)
    policy = policy_class(config.policy_name)(config.policy, policy_sizes(train))
    _set_statistics(policy, train, config)
    policy.start_from(train)
    return policy


def _set_statistics(policy: SequencePolicy, base: EpisodeStore, config: Config) -> None:
    mean, std = base.state_statistics
    policy.state_mean.copy_(mean)
    policy.state_std.copy_(torch.where(std > 1e-6, std, 1.0))
    scale = config.policy.return_scale or float(np.abs(base.returns).max()) or 1.0
    returns_to_go = base.column(schema.RETURN_TO_GO)
    if not returns_of(base, config).per_session and not config.policy.return_scale:
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
