"""A training run (Algorithm 1) and the folder that holds it."""

import dataclasses
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ucfrec import schema
from ucfrec.counterfactual.augment import counterfactual_copies, require_rewards_vary
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.episodes.windows import Overlay, Windows
from ucfrec.errors import InputError
from ucfrec.files import atomic_folder, read_json, write_json
from ucfrec.fitting.loop import fit
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import command_line, versions
from ucfrec.runs.config import Config, config_from_dict
from ucfrec.runs.reference_losses import reference_losses
from ucfrec.runs.samples import SAMPLES, sample_recommendations
from ucfrec.runs.trained_policy import AUGMENTATION, COUNTS, ITEMS, RUN, USERS

_VALIDATION_BATCHES = 16
_VALIDATION_BATCH = 256
_QUANTILES = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)


@random_state_kept()
def train_run(
    store: EpisodeStore,
    out: Path,
    config: Config,
    about: Mapping[str, Any] | None = None,
    more_copies: Overlay | None = None,
) -> dict[str, Any]:
    """Train a policy on the training episodes of `store`, or go on where `out` was left.

    Reward model, generator, edited copies (unless `augment.copies` is 0), then the policy; each
    stage that is finished is kept. `out` comes into being once all that can be checked has been:
    a start that fails leaves nothing. The global random state is as before on return.

    Args:
        about: what an adapter adds to the record.
        more_copies: an adapter's own edited copies of training episodes, beside the counterfactual
            ones.

    Returns:
        The record in `run.json`: command, configuration, seed, store fingerprint, versions, wall
        time and what every stage reports.

    Raises:
        InputError: `out` is a run on another store or with another configuration, the store has
            too few training episodes, or the learner cannot act on it.
    """
    train, validation = training_views(store)
    if (out / RUN).exists():
        _require_same(read_json(out / RUN), store, out, config)
    elif config.augment.copies > 0:
        require_rewards_vary(train)
    policy = new_policy(train, config)
    if not (out / RUN).exists():
        _begin(store, train, validation, out, config, about or {})
    record = read_json(out / RUN)
    record["config"] = dataclasses.asdict(config)
    began = time.perf_counter() - record["wall_time_s"]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    view = policy.training_view(train, config.policy, out / "view", config.seed)
    if view is not train:
        train, policy = view, new_policy(view, config)
    policy = policy.to(device)
    if config.augment.copies > 0:
        overlay, record["augmentation"] = _counterfactuals(train, validation, out, config)
        more_copies = overlay if more_copies is None else overlay.joined(more_copies)
    if more_copies is not None:
        train = train.with_overlay(more_copies)
    k = policy.config.context

    def draw(generator: np.random.Generator) -> Windows:
        return train.windows(*train.draw_steps(generator, config.train.batch_size), k).to(device)

    fitted = fit(
        policy,
        draw,
        policy.loss,
        config.train,
        out / "policy",
        seed=config.seed,
        validate=_validation(policy, validation, config.seed),
        describe=config.policy_name,
    )
    record["policy"] = dataclasses.asdict(fitted)
    record["wall_time_s"] = time.perf_counter() - began
    if store.has_items:
        target = max(record["return_quantiles"].values())
        write_json(out / SAMPLES, sample_recommendations(policy, validation, target))
    write_json(out / RUN, record)
    return dict(record)


def training_views(store: EpisodeStore) -> tuple[EpisodeStore, EpisodeStore]:
    """Episodes to learn from and, apart, to validate on: the store's splits, or, where none is for
    validation, every tenth training episode."""
    train, validation = store.split("train"), store.split("validation")
    if train.n_episodes < 2:
        raise InputError(
            f"{store.path} has {train.n_episodes} training episodes; prepare it with a later split"
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
        "fingerprint": store.meta["fingerprint"],
        "reward": store.meta["reward"],
        "session_by": store.meta["source"].get("session_by"),
        "session_gap_ms": store.meta["source"].get("session_gap_ms"),
        "sizes": _sizes(store),
        "observation_size": store.observation_size,
        "train_episodes": train.n_episodes,
        "train_steps": train.n_steps,
        "return_quantiles": {str(q): float(np.quantile(train.returns, q)) for q in _QUANTILES},
        "mean_return": float(train.returns.mean()),
        "data": store.meta["source"],
        "versions": versions(),
        "wall_time_s": 0.0,
        **about,
    }
    with atomic_folder(out) as scratch:
        for name in (ITEM_STATES, ITEMS, USERS):
            if (store.path / name).exists():
                shutil.copyfile(store.path / name, scratch / name)
        if store.has_items:
            counts = TrainingCounts.of(train)
            counts.save(scratch / COUNTS)
            record["reference_losses"] = reference_losses(counts, validation)
        write_json(scratch / RUN, record)


def _require_same(
    record: Mapping[str, Any], store: EpisodeStore, out: Path, config: Config
) -> None:
    if record["fingerprint"] != store.meta["fingerprint"]:
        raise InputError(
            f"{out} is a run on another store ({record['store']}, fingerprint "
            f"{record['fingerprint'][:12]}), not on {store.path} "
            f"({store.meta['fingerprint'][:12]}); name another run folder"
        )
    began = config_from_dict(record["config"])
    if not config.train.cosine:
        # More steps are no other run: training goes on from where it ended.
        longer = dataclasses.replace(began.train, steps=config.train.steps)
        began = dataclasses.replace(began, train=longer)
    before, now = dataclasses.asdict(began), dataclasses.asdict(config)
    for table, values in now.items():
        if before[table] != values:
            was = _difference(before[table], values)
            raise InputError(
                f"{out} was begun with another {table} ({was}); name another run folder, or give "
                "the same configuration to resume"
            )


def _difference(before: Any, now: Any) -> str:
    if not isinstance(now, Mapping):
        return f"{before} there, {now} here"
    return ", ".join(
        f"{key} is {before.get(key)} there, {value} here"
        for key, value in now.items()
        if before.get(key) != value
    )


def _counterfactuals(
    train: EpisodeStore, validation: EpisodeStore, out: Path, config: Config
) -> tuple[Overlay, dict[str, Any]]:
    """Edited copies and what is reported of them, made once a run."""
    overlay_path, report_path = out / "overlay.safetensors", out / AUGMENTATION
    if not report_path.exists():
        overlay, report = counterfactual_copies(
            train, validation, config.crm, config.csg, config.augment, out, config.seed
        )
        overlay.save(overlay_path)
        write_json(report_path, dataclasses.asdict(report))
    return Overlay.load(overlay_path), read_json(report_path)


def _sizes(store: EpisodeStore) -> dict[str, int]:
    columns = store.meta["columns"]
    if store.has_items:
        items, dim = store.item_states.embeddings.shape
        return {"state": store.state_size, "action": dim, "items": items}
    return {"state": store.state_size, "action": columns[schema.ACTION][0], "items": 0}


@random_state_kept()
def new_policy(train: EpisodeStore, config: Config) -> SequencePolicy:
    """A policy with the normalisation and item embeddings of `train`, its weights untrained."""
    torch.manual_seed(config.seed)
    policy = policy_class(config.policy_name)(config.policy, _sizes(train))
    base = train.without_copies()
    mean, std = base.state_statistics
    policy.state_mean.copy_(mean)
    policy.state_std.copy_(torch.where(std > 1e-6, std, 1.0))
    scale = config.policy.return_scale or float(np.abs(base.returns).max()) or 1.0
    policy.return_scale.fill_(scale)
    episodes, steps = base.all_steps()
    asked = base.step_values(schema.RETURN_TO_GO, episodes, steps)
    policy.lowest_return_to_go.fill_(float(asked.min()))
    if isinstance(policy.head, ItemHead):
        counts = np.bincount(
            base.step_values(schema.ITEM, episodes, steps), minlength=len(policy.head.counts)
        )
        policy.head.start_from(base.item_states.embeddings, torch.from_numpy(counts).float())
    else:
        actions = base.step_values(schema.ACTION, episodes, steps)
        policy.head.scale.copy_(torch.from_numpy(np.abs(actions).max(0)).clamp(min=1.0))
    policy.start_from(base)
    return policy


def _validation(policy: SequencePolicy, validation: EpisodeStore, seed: int) -> Any:
    """The mean action loss at held-out steps, the same ones at every call."""
    generator = np.random.default_rng([seed, 0])
    drawn = [
        validation.draw_steps(generator, _VALIDATION_BATCH) for _ in range(_VALIDATION_BATCHES)
    ]
    k, device = policy.config.context, policy.state_mean.device
    windows = [validation.windows(*steps, k) for steps in drawn]

    def loss() -> float:
        return float(torch.stack([policy.action_loss(w.to(device)) for w in windows]).mean())

    return loss


def describe_run(record: Mapping[str, Any]) -> str:
    """What a finished run found, in a few lines."""
    lines = []
    if "augmentation" in record:
        report = record["augmentation"]
        crm, moves = report["reward_model"], report["moves"]
        lines += [
            f"reward model  R² {crm['r2']:.3f} with z, {crm['r2_without_z']:.3f} without; "
            f"{crm['active_dimensions']} of {crm['latent_dim']} latent dimensions active",
            f"edits         {report['copies']} copies, acceptance {report['acceptance']:.1%}, "
            f"mean-move ratio {moves['mean_move_ratio']:.2f}, effective rank "
            f"{moves['effective_rank']:.1f} of {moves['dimensions']}",
            f"bound         δ + ε_r = {report['delta']:.3g} + {report['epsilon_r']:.3g}: "
            f"{report['verdict']}",
        ]
        lines += [f"warning       {warning}" for warning in report["warnings"]]
    policy = record["policy"]
    lines.append(
        f"policy        best validation loss {policy['best_validation']:.4g} at step "
        f"{policy['best_step']} of {policy['steps']}, {policy['seconds']:.0f} s"
    )
    return "\n".join(lines)
