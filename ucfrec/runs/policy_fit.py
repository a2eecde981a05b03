"""Fit the policy of a run, by gradients or by one call of a solver."""

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec import schema
from ucfrec.arrays import IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes, TrainingEpisodes, Windows
from ucfrec.errors import InputError
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import MetricsLog, load_tensors, load_weights, save_tensors
from ucfrec.fitting.loop import SILENT, Callbacks, Fit, fit
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.runs.config import Config
from ucfrec.user_model.running import Demand

_VALIDATION_BATCHES = 16
_VALIDATION_BATCH = 256


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
    """Train the policy in place, or resume its training. InputError as of
    `ucfrec.fitting.loop.fit`, or if the batch has fewer windows than processes.

    Args:
        validation: held-out episodes; None to keep the last weights.
        start: weights of another training to go on from; of a policy that is fitted without
            gradients, only what was chosen on held-out episodes is taken from there.
        newest: positions in `train` of episodes that half of every batch is drawn from; None to
            draw all uniformly.
        augmented: episodes to learn from in addition to those of `train`.
    """
    k, device, folder = policy.config.context, policy.state_mean.device, out / "policy"
    solve = policy.make_solver(train, validation, folder, config.seed)
    if start is not None:
        weights = load_tensors(start)[0]
        names = policy.state_dict().keys() if solve is None else policy.chosen
        policy.load_state_dict({name: weights[name] for name in names}, strict=solve is None)
    alone = solve is not None or distributed.processes() == 1
    windows = []
    # Where items do not come and go, one without training steps cannot be learned.
    learnable = train.item_counts() > 0 if train.has_items and not train.has_offers else None
    if validation is not None:
        generator = np.random.default_rng([config.seed, 0])
        for number in range(_VALIDATION_BATCHES):
            episodes, steps = validation.draw_steps(generator, _VALIDATION_BATCH)
            if learnable is not None:
                items = validation.items_at(episodes, steps)
                if (inside := learnable[items]).any():
                    episodes, steps = episodes[inside], steps[inside]
            if alone or number % distributed.processes() == distributed.rank():
                windows.append(validation.windows(episodes, steps, k))

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
    if isinstance(policy.head, ItemHead) and schema.TIMESTAMP in train.record.columns:
        demand = None if train.has_offers else Demand.of(train, validation, policy.head.mixture)
        if demand is not None:
            policy.head.follow(demand)
    size, rows = config.train.batch_size, distributed.share(config.train.batch_size)
    newest = np.array([], dtype=np.int64) if newest is None else newest
    recent = train.select(newest)
    training = train if augmented is None else TrainingEpisodes(train, augmented)
    reach = k if isinstance(policy.head, ItemHead) and not policy.literal else 1

    def draw(generator: np.random.Generator) -> Windows:
        episodes, steps = training.draw_steps(generator, size, reach)
        if len(newest):
            of_recent, steps[::2] = recent.draw_steps(generator, len(steps[::2]), reach)
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
    """Fit `module` by one call of `solve`, or read it from `folder`; leaves the files of a step."""
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
        logged = {} if validate is None else {"validation_loss": validate()}
    loss = logged.get("validation_loss", math.nan)
    if logged and not math.isfinite(loss):
        raise InputError(f"{describe}: the validation loss is {loss}; look for extreme values")
    seconds = time.perf_counter() - start
    log = MetricsLog(folder, 0)
    log.add(1, logged)
    log.close()
    metadata = {"step": 1, "best_step": 1, "best_validation": loss, "seconds": seconds}
    save_tensors(folder / "best.safetensors", module.state_dict(), metadata)
    save_tensors(last, module.state_dict(), metadata)
    if callbacks.on_validation is not None:
        callbacks.on_validation(1, logged)
    return Fit(1, 1, loss, seconds)
