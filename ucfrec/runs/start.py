"""A run begins: its episodes, its record, and its policy, untrained or warm."""

import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.counterfactual.augmentation import CRM, require_rewards_vary
from ucfrec.counterfactual.reward_model import INITIAL
from ucfrec.episodes.item_table import OFFERS
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.states import TrainingCounts
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore, UserRows
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, atomic_folder, write_json
from ucfrec.fitting.checkpoint import save_tensors
from ucfrec.fitting.loop import load_trained
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.registry import policy_class, policy_package
from ucfrec.processes import random_state_kept
from ucfrec.provenance import command_line, versions
from ucfrec.runs.config import Config
from ucfrec.runs.record import REFIT, RUN, RunRecord, place_of, read_record, refit_of_run
from ucfrec.runs.trained_policy import COUNTS, ITEMS, RETURNS, RULE, USERS, TrainedPolicy
from ucfrec.user_model.reward_fit import reward_model_sizes

_SHARE = 1 / 16
"""Steps of a warm training, as a share of those of one from scratch."""
_MOST_RETURNS = 1_000_001
_QUANTILES = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
_SCALES = ("state_mean", "state_std", "return_scale", "lowest_return_to_go", "head.prior")
"""Buffers of a policy that its weights were trained with."""
_OFFERED = 2**28
"""Most pairs of a step and an item of which it is asked whether the item was on offer, …"""
_AT_ONCE = 2**20
"""… and of which it is asked at once."""
_CRM_EPOCHS = 5
"""Epochs that `crm.epochs` 0 stands for."""


def training_views(store: EpisodeStore) -> tuple[EpisodeStore, EpisodeStore]:
    """The training and the validation episodes of a store.

    Without a validation split, every tenth training episode is held out for validation. InputError
    if the store has fewer than 2 training episodes.
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
    return train.divide(np.arange(train.n_episodes) % 10 == 1)


def continue_users(later: EpisodeStore, train: EpisodeStore) -> EpisodeStore:
    """Later episodes with the training steps of their users before them, where sessions are users;
    otherwise as they are. What `all_steps` lists does not change."""
    if not train.has_users or train.record.source.session_by != "user":
        return later
    return UserRows.of(later, later.episode_values(schema.USER), train).continue_sessions(None)


def require_startable(
    store: EpisodeStore,
    train: EpisodeStore,
    out: Path,
    config: Config,
) -> None:
    """Check that a run can begin, or go on, in the folder `out`; InputError if it holds another, or
    if rewards never vary, which augmentation needs."""
    if not (out / RUN).exists():
        if config.augment.augments:
            require_rewards_vary(train)
        return
    record = RunRecord.read(out)
    if not record.is_of(store.record):
        run_log, store_log = record.fingerprint[:12], store.record.fingerprint[:12]
        raise InputError(
            f"{out} is a run on another store ({record.store}, fingerprint {run_log}), not on "
            f"{store.path} ({store_log}), or on other item states than that has; name another "
            "folder"
        )
    started = record.config
    if not config.train.cosine and config.train.steps > started.train.steps:
        # Without a cosine schedule, a run may be resumed with more steps.
        started = replace(started, train=replace(started.train, steps=config.train.steps))
    for table, values in asdict(config).items():
        earlier_values = asdict(started)[table]
        old, new = (v if isinstance(v, dict) else {table: v} for v in (earlier_values, values))
        differences = [
            f"{key} is {old.get(key)} in the run, {value} now"
            for key, value in new.items()
            if old.get(key) != value
        ]
        if differences:
            raise InputError(
                f"{out} was started with another {table} ({', '.join(differences)}); name another "
                "run folder, or give the same configuration to resume"
            )


def begin(
    store: EpisodeStore,
    train: EpisodeStore,
    validation: EpisodeStore,
    out: Path,
    config: Config,
    additions: Mapping[str, Any],
) -> None:
    """Write the folder of a run with its record and all that training does not change.

    Targets are chosen from the sorted returns-to-go of sessions, or of steps if they are set again
    at every step, without sessions as long as only those of bots. Of more than a million, evenly
    spaced order statistics are kept, the lowest and highest too.
    """
    source = store.record.source
    returns_to_go = config.policy.returns(source.session_by)
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
        **additions,
    }
    people = train.without_long_sessions() if train.has_items else train
    returns = people.returns
    if not returns_to_go.per_session:
        returns = people.with_return_to_go(returns_to_go).column(schema.RETURN_TO_GO)
    number = min(len(returns), _MOST_RETURNS)
    places = np.linspace(0, len(returns) - 1, number).astype(np.int64)
    returns = np.sort(returns)[places].astype(np.float32)
    with atomic_folder(out) as scratch:
        save_tensors(scratch / RETURNS, {"returns": torch.from_numpy(returns)}, {})
        target = float(np.quantile(returns.astype(np.float64), config.rule.default_quantile))
        rule = DecisionRule(target, tag_window=config.rule.default_tag_window)
        write_json(scratch / RULE, rule.as_dict())
        # Sets of candidates are those of the steps: requests have their own.
        for name in (ITEM_STATES, ITEMS, USERS, *([OFFERS] if store.has_offers else [])):
            with suppress(FileNotFoundError):
                shutil.copyfile(store.path / name, scratch / name)
        if store.has_items:
            counts = TrainingCounts.of(train)
            counts.save(scratch / COUNTS)
            entries["reference_losses"] = {
                name: _mean_loss(validation, scores, counts.shown)
                for name, scores in (
                    ("uniform", torch.zeros(len(counts.shown))),
                    # As the bias of `ItemHead` is initialised.
                    ("popularity", torch.log(counts.shown + 1.0)),
                )
            }
        RunRecord.of(entries, out / RUN).seal(scratch)


def _count_even_draws(train: EpisodeStore) -> Tensor | None:
    """(n_items,) expected counts of items drawn evenly from what was on offer; None for all."""
    counts, steps = torch.zeros(len(train.item_states.embeddings)), 0
    for offer, _ in _sample_offers(train):
        if offer is None:
            return None
        offered = offer.mask().float()
        counts += (offered / offered.sum(1, keepdim=True).clamp(min=1)).sum(0)
        steps += len(offered)
    return counts * (train.n_steps / max(1, steps))


def _mean_loss(view: EpisodeStore, scores: Tensor, counts: Tensor) -> float:
    """Mean −log softmax (nats), over what was on offer, of the scores (n_items,) of items shown; of
    those with training steps, by `counts` (n_items,), as in `fit_policy`."""
    losses = []
    for offer, items in _sample_offers(view):
        if offer is None:
            items = torch.from_numpy(view.column(schema.ITEM)).long()
            learnable = items[counts[items] > 0]
            items = learnable if len(learnable) else items
            return -float(scores.log_softmax(0)[items].double().mean())
        offered = offer.mask().scatter(1, items.unsqueeze(1), True)
        logs = scores.masked_fill(~offered, -torch.inf).log_softmax(1)
        losses.append(-logs.gather(1, items.unsqueeze(1)))
    return float(torch.cat(losses).double().mean()) if losses else math.nan


def _sample_offers(view: EpisodeStore) -> Iterator[tuple[Offer | None, Tensor]]:
    """Offers and shown items of steps of the view, some at a time, evenly spaced if many."""
    n_items = len(view.item_states.embeddings)
    numbers = np.arange(0, view.n_steps, -(-view.n_steps * n_items // _OFFERED) or 1)
    for part in np.array_split(numbers, -(-len(numbers) * n_items // _AT_ONCE) or 1):
        episodes, steps = view.locate(part)
        items = view.items_at(episodes, steps)
        yield view.offer(episodes, steps), torch.from_numpy(items)


def policy_sizes(store: EpisodeStore) -> dict[str, int]:
    """Sizes of states and actions, and of the catalogue (0 for vectors), that policies have."""
    if store.has_items:
        return reward_model_sizes(store)
    return {"state": store.state_size, "action": store.record.columns[schema.ACTION][0], "items": 0}


@random_state_kept()
def new_policy(train: EpisodeStore, config: Config) -> SequencePolicy:
    """An untrained policy with the normalisation and item embeddings of `train`. InputError if the
    policy does not support the actions of `train`."""
    torch.manual_seed(config.seed)
    policy = policy_class(config.policy_name)(config.policy, policy_sizes(train))
    mean, std = train.state_statistics
    policy.state_mean.copy_(mean)
    policy.state_std.copy_(torch.where(std > 0, std, 1.0))
    returns_to_go = train.column(schema.RETURN_TO_GO)
    per_session = config.policy.returns(train.record.source.session_by).per_session
    scaled_by = train.returns if per_session else returns_to_go
    policy.return_scale.fill_(config.policy.return_scale or float(np.abs(scaled_by).max()) or 1.0)
    policy.lowest_return_to_go.fill_(float(returns_to_go.min()))
    if isinstance(policy.head, ItemHead):
        counts = torch.from_numpy(train.item_counts()).float()
        policy.head.start_from(train.item_states.embeddings, counts, _count_even_draws(train))
        if not (policy.literal or train.has_offers):
            policy.begin_with_items()
        if policy.head.exposure is not None:
            scaled = torch.from_numpy(returns_to_go) / policy.return_scale
            policy.head.exposure.start_from(train.item_states, scaled)
    else:
        actions = train.column(schema.ACTION)
        largest = torch.from_numpy(np.abs(actions).max(0))
        policy.head.scale.copy_(largest.clamp(min=1e-30))
    policy.start_from(train)
    return policy


@torch.no_grad()
def start_warm(policy: SequencePolicy, out: Path, initial: Path) -> None:
    """Give a policy, and the reward model of its augmentation in `out`, the weights of another run.

    Rows of users and items that the other run does not know keep what the new policy begins with:
    for items no correction of their vector, and the log of their share of the training steps.
    """
    acting = initial if refit_of_run(initial, read_record(initial)) is None else initial / REFIT
    trained = load_trained(acting / "policy" / "best.safetensors")
    state, names = policy.state_dict(), dict(policy.named_parameters())
    for name in sorted(state.keys() & trained.keys()):
        new, old = state[name], trained[name]
        fits = new.shape[1:] == old.shape[1:] and new.numel() >= old.numel()
        if fits and (name in names or name in _SCALES):
            new.view(-1)[: old.numel()] = old.flatten()
    best, target = initial / CRM / "cvae" / "best.safetensors", out / CRM / INITIAL
    if best.exists() and not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(target) as scratch:
            shutil.copyfile(best, scratch)


def rule_to_start_from(initial: Path, new: TrainedPolicy) -> DecisionRule:
    """The rule of a run, in the units of another: targets are the same quantile of the training
    returns, and the lookahead the same number of mean rewards."""
    old = TrainedPolicy.load(initial, split=True)
    rule, quantiles = old.rule, np.array(new.record.config.rule.quantiles)
    distances = [abs(old.target_return(quantile) - rule.target) for quantile in quantiles]
    moved = new.target_return(float(quantiles[np.argmin(distances)]))
    least = None if rule.minimum_target is None else moved
    rule = replace(rule, target=moved, minimum_target=least)
    reward, old_reward = (
        record.mean_return * record.train_episodes / record.train_steps
        for record in (new.record, old.record)
    )
    return replace(rule, lookahead=rule.lookahead * reward / old_reward if old_reward > 0 else 0.0)


def warm_settings(config: Config) -> Config:
    """The settings of a warm training, of `_SHARE` of the steps and epochs of one from scratch."""
    steps = max(1, round(_SHARE * config.train.steps))
    warmup = min(config.train.warmup, steps // 10)
    every = min(config.train.validate_every, steps)
    train = replace(config.train, steps=steps, warmup_steps=warmup, validate_every=every)
    epochs = max(1, round(_SHARE * (config.crm.epochs or _CRM_EPOCHS)))
    return replace(config, train=train, crm=replace(config.crm, epochs=epochs))
