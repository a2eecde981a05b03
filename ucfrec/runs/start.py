"""A run begins: its episodes, its record, its policy, untrained or warm, and how that is fitted."""

import math
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import IntArray
from ucfrec.counterfactual.augmentation import CRM, require_rewards_vary
from ucfrec.counterfactual.reward_model import INITIAL
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import TrainingCounts
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes, TrainingEpisodes, Windows
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, atomic_folder, write_json
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import load_tensors, load_weights, save_tensors
from ucfrec.fitting.loop import SILENT, Callbacks, Fit, fit, load_trained
from ucfrec.fitting.metrics import MetricsLog
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.registry import policy_class, policy_package
from ucfrec.processes import random_state_kept
from ucfrec.provenance import command_line, versions
from ucfrec.runs.config import Config
from ucfrec.runs.record import REFIT, RUN, RunRecord, place_of, read_record, refit_of_run
from ucfrec.runs.trained_policy import COUNTS, ITEMS, RETURNS, RULE, USERS, TrainedPolicy
from ucfrec.user_model.reward_fit import reward_model_sizes

SHARE: Final = 1 / 16
"""Steps of a warm training, as a share of those of one from scratch."""
_MOST_RETURNS: Final = 1_000_001
_QUANTILES: Final = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
_SCALES: Final = ("state_mean", "state_std", "return_scale", "lowest_return_to_go")
"""Buffers of a policy that its weights were trained with."""
_CRM_EPOCHS: Final = 5
"""Epochs that `crm.epochs` 0 stands for."""
_VALIDATION_BATCHES: Final = 16
_VALIDATION_BATCH: Final = 256


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
    if not (out / RUN).exists():
        if config.augment.augments:
            require_rewards_vary(train)
        return
    record = RunRecord.read(out)
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
    settings = asdict(started)
    for table, values in asdict(config).items():
        if (previous := settings[table]) == values:
            continue
        difference = f"{previous} in the run, {values} now"
        if isinstance(values, Mapping):
            difference = ", ".join(
                f"{key} is {previous.get(key)} in the run, {value} now"
                for key, value in values.items()
                if previous.get(key) != value
            )
        raise InputError(
            f"{out} was started with another {table} ({difference}); name another run folder, "
            "or give the same configuration to resume"
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
        **additions,
    }
    people = train.without_long_sessions() if train.has_items else train
    returns = people.returns
    if not returns_to_go.per_session:
        returns = people.with_return_to_go(returns_to_go).column(schema.RETURN_TO_GO)
    places = np.linspace(0, len(returns) - 1, min(len(returns), _MOST_RETURNS)).astype(np.int64)
    returns = np.asarray(np.sort(returns)[places], dtype=np.float32)
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
            items = torch.from_numpy(validation.column(schema.ITEM)).long()
            # As the bias of `ItemHead` is initialised.
            log_shares = torch.log((counts.shown + 1) / (counts.shown + 1).sum())
            entries["reference_losses"] = {
                "uniform": math.log(len(counts.shown)),
                "popularity": -float(log_shares[items].double().mean()),
            }
        RunRecord.of(entries, out / RUN).seal(scratch)


def returns_of(store: EpisodeStore, config: Config) -> ReturnToGo:
    """What the returns-to-go of a run on `store` count."""
    return config.policy.returns(store.record.source.session_by)


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
    returns_to_go = base.column(schema.RETURN_TO_GO)
    scaled_by = base.returns if returns_of(base, config).per_session else returns_to_go
    policy.return_scale.fill_(config.policy.return_scale or float(np.abs(scaled_by).max()) or 1.0)
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


@torch.no_grad()
def start_warm(policy: SequencePolicy, out: Path, initial: Path) -> None:
    """Give a policy, and the reward model of its augmentation, the weights of another run.

    Rows of users and items that the other run does not know keep what the new policy begins with:
    for items no correction of their vector, and the log of their share of the training steps.

    Args:
        out: folder of the new run, which receives the reward model's weights.
    """
    acting = initial if refit_of_run(initial, read_record(initial)) is None else initial / REFIT
    path = acting / "policy" / "best.safetensors"
    trained, names = load_trained(path), {name for name, _ in policy.named_parameters()}
    state = policy.state_dict()
    for name in sorted(state.keys() & trained.keys()):
        new, old = state[name], trained[name]
        if name not in names and name not in _SCALES:
            continue
        if new.shape == old.shape:
            new.copy_(old)
        elif new.shape[1:] == old.shape[1:] and len(new) > len(old):
            new[: len(old)] = old
    best, target = initial / CRM / "cvae" / "best.safetensors", out / CRM / INITIAL
    if best.exists() and not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(target) as scratch:
            shutil.copyfile(best, scratch)


def rule_to_start_from(initial: Path, new: TrainedPolicy) -> DecisionRule:
    """The rule of a run, in the units of another: targets are the same quantile of the training
    returns, and the lookahead the same number of mean rewards."""
    old = TrainedPolicy.load(initial, split=True)
    rule, quantiles = old.rule, new.record.config.rule.quantiles
    if rule.target is not None:
        target = rule.target
        nearest = min(quantiles, key=lambda quantile: abs(old.target_return(quantile) - target))
        moved = new.target_return(nearest)
        least = None if rule.minimum_target is None else moved
        rule = replace(rule, target=moved, minimum_target=least)
    reward, old_reward = (
        record.mean_return * record.train_episodes / record.train_steps
        for record in (new.record, old.record)
    )
    return replace(rule, lookahead=rule.lookahead * reward / old_reward if old_reward > 0 else 0.0)


def warm_settings(config: Config, share: float = SHARE) -> Config:
    """The settings of a warm training.

    Args:
        share: of the steps and epochs of a training from scratch.
    """
    steps = max(1, round(share * config.train.steps))
    train = replace(
        config.train,
        steps=steps,
        warmup_steps=min(config.train.warmup_steps, steps // 10),
        validate_every=min(config.train.validate_every, steps),
    )
    epochs = max(1, round(share * (config.crm.epochs or _CRM_EPOCHS)))
    return replace(config, train=train, crm=replace(config.crm, epochs=epochs))


def fit_policy(
    policy: SequencePolicy,
    train: EpisodeStore,
    validation: EpisodeStore | None,
    out: Path,
    config: Config,
    start: Path | None = None,
    newest: IntArray | None = None,
    callbacks: Callbacks = SILENT,
    augmented: AugmentedEpisodes | None = None,
) -> Fit:
    """Train the policy, or resume its training.

    Args:
        policy: trained in place.
        train: episodes to learn from.
        validation: held-out episodes; None to keep the last weights.
        start: weights of another training to go on from; of a policy that is fitted without
            gradients, only what was chosen on held-out episodes is taken from there.
        newest: positions in `train` of episodes that half of every batch is drawn from; None to
            draw all uniformly.
        augmented: episodes to learn from in addition to those of `train`.

    Raises:
        InputError: see `ucfrec.fitting.loop.fit`; or the batch has fewer windows than processes.
    """
    k, device, folder = policy.config.context, policy.state_mean.device, out / "policy"
    solve = policy.make_solver(train, validation, folder, config.seed)
    if start is not None:
        weights = load_tensors(start)[0]
        names = policy.state_dict().keys() if solve is None else policy.chosen
        policy.load_state_dict({name: weights[name] for name in names}, strict=solve is None)
    alone = solve is not None or distributed.processes() == 1
    windows = []
    if validation is not None:
        generator = np.random.default_rng([config.seed, 0])
        samples = [
            validation.draw_steps(generator, _VALIDATION_BATCH) for _ in range(_VALIDATION_BATCHES)
        ]
        if not alone:
            samples = samples[distributed.rank() :: distributed.processes()]
        windows = [validation.windows(episodes, steps, k) for episodes, steps in samples]

    def mean_loss() -> float:
        """Mean action loss at a fixed sample of validation steps."""
        on_device = windows if device.type == "cpu" else [batch.to(device) for batch in windows]
        losses = [policy.action_loss(batch) for batch in on_device]
        mean = float(torch.stack(losses).mean()) if losses else 0.0
        return mean if alone else distributed.joint_means({"loss": mean}, len(losses))["loss"]

    validate = None if validation is None else mean_loss
    if solve is not None:
        with distributed.leader_first():
            return _fit_once(policy, solve, folder, validate, config.policy_name, callbacks)
    size, rows = config.train.batch_size, distributed.share(config.train.batch_size)
    newest = np.array([], dtype=np.int64) if newest is None else newest
    recent = train.select(newest)
    training = train if augmented is None else TrainingEpisodes(train, augmented)

    def draw(generator: np.random.Generator) -> Windows:
        episodes, steps = training.draw_steps(generator, size)
        if len(newest):
            of_recent, steps[::2] = recent.draw_steps(generator, len(steps[::2]))
            episodes[::2] = newest[of_recent]
        windows = training.windows(episodes[rows], steps[rows], k)
        return windows if device.type == "cpu" else windows.to(device)

    def loss(windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        lower = config.train.precision == "bfloat16"
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=lower):
            value, scalars = policy.loss(windows)
        return value.float(), scalars

    return fit(
        policy,
        draw,
        loss,
        config.train,
        folder,
        seed=config.seed,
        validate=validate,
        describe=config.policy_name,
        rows=lambda windows: float(windows.mask.sum()),
        callbacks=callbacks,
    )


def _fit_once(
    module: nn.Module,
    solve: Callable[[], None],
    folder: Path,
    validate: Callable[[], float] | None,
    describe: str,
    callbacks: Callbacks,
) -> Fit:
    """Fit `module` by one call of `solve`, or read it from `folder` if that was done before.

    Leaves the files of `ucfrec.fitting.loop.fit` in `folder`, as after a single step, and the
    module in evaluation mode.
    """
    folder.mkdir(parents=True, exist_ok=True)
    last = folder / "last.safetensors"
    if last.exists():
        tensors, counters = load_tensors(last)
        load_weights(last, module, tensors)
        module.eval()
        return Fit(1, 1, counters["best_validation"], counters["seconds"])
    start = time.perf_counter()
    solve()
    module.eval()
    with torch.no_grad():
        loss = math.nan if validate is None else validate()
    if validate is not None and not math.isfinite(loss):
        raise InputError(f"{describe}: the validation loss is {loss}; look for extreme values")
    seconds = time.perf_counter() - start
    logged = {} if validate is None else {"validation_loss": loss}
    log = MetricsLog(folder, 0)
    log.add(1, logged)
    log.close()
    metadata = {"step": 1, "best_step": 1, "best_validation": loss, "seconds": seconds}
    save_tensors(folder / "best.safetensors", module.state_dict(), metadata)
    save_tensors(last, module.state_dict(), metadata)
    if callbacks.on_validation is not None and distributed.leads():
        callbacks.on_validation(1, logged)
    return Fit(1, 1, loss, seconds)
