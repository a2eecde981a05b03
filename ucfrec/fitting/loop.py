"""The one training loop, of reward model, generator and every policy."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import (
    load_tensors,
    load_training,
    load_weights,
    save_tensors,
    save_training,
)
from ucfrec.fitting.metrics_log import MetricsLog
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.progress import Progress, progress
from ucfrec.settings import BatchSize, Count, LearningRate, WeightDecay, settings_table

Batch = TypeVar("Batch")


@settings_table("train")
class LoopConfig:
    """How long and how fast to learn.

    Policy defaults are the paper's Table 8; `steps` and the rest are ours.
    """

    steps: Count = 10_000
    """Updates in all."""
    batch_size: BatchSize = 64
    """Windows of an update."""
    learning_rate: LearningRate = 1e-4
    """Step size of the updates, once warm."""
    weight_decay: WeightDecay = 1e-4
    """AdamW's pull of the weights towards 0."""
    warmup_steps: Annotated[int, Field(ge=0, le=10**12)] = 500
    """Steps in which the learning rate rises linearly; then it stays, or falls along a cosine. A
    training of fewer steps ends before it has risen."""
    cosine: bool = False
    """After the warm-up, fall to 0 at the last step instead of staying constant."""
    clip_norm: Annotated[float, Field(ge=0, le=1e6)] = 0.25
    """Largest gradient norm; 0 clips nothing."""
    validate_every: Count = 500
    """Steps between validations, checkpoints and log lines."""
    patience: Annotated[int, Field(ge=0, le=10**9)] = 0
    """Validations without a better one before stopping early; 0 never stops early."""


@dataclass(frozen=True)
class Fit:
    """What a training loop ended with."""

    steps: int
    best_step: int
    best_validation: float
    """Lowest validation loss; NaN without validation."""
    seconds: float


def step_generator(seed: int, step: int) -> np.random.Generator:
    """The generator from which everything random of one training step is drawn.

    Step i needs no history: a run resumed at i draws the same as an uninterrupted one.
    """
    return np.random.default_rng([seed, step])


@random_state_kept()
def fit(
    module: nn.Module,
    draw: Callable[[np.random.Generator], Batch],
    loss: Callable[[Batch], tuple[Tensor, Mapping[str, Tensor]]],
    config: LoopConfig,
    folder: Path,
    *,
    seed: int,
    validate: Callable[[], float] | None = None,
    describe: str = "train",
) -> Fit:
    """Minimise `loss` over batches from `draw`, resuming from `folder` if it holds a checkpoint.

    Writes `last.safetensors` (all that resuming needs), `best.safetensors` (weights with the lowest
    validation loss; the last weights without validation), `metrics.jsonl` and TensorBoard events to
    `folder`. A run killed at any moment and started again ends with the same weights as an
    uninterrupted one (same machine and device). The global random state is as before when it
    returns or raises.

    Args:
        module: what is trained, in place; holds the best weights on return.
        draw: a batch from a generator.
        loss: the scalar to minimise and scalars to log.
        validate: the loss on held-out data, in evaluation mode and without gradients.

    Raises:
        InputError: the loss is no longer finite.
    """
    folder.mkdir(parents=True, exist_ok=True)
    last, best = folder / "last.safetensors", folder / "best.safetensors"
    optimizer = _optimizer(module, config)
    counters = {"step": 0, "best_step": 0, "best_validation": math.inf, "stale": 0, "seconds": 0.0}
    if last.exists():
        counters.update(load_training(last, module, optimizer))
    step = int(counters["step"])
    clock, log = _Clock(step, counters["seconds"]), MetricsLog(folder, step)
    for step, shown in _steps(counters, config, describe):
        generator = step_generator(seed, step)
        with clock.waiting():
            batch = draw(generator)
        torch.manual_seed(int(generator.integers(2**62)))
        module.train()
        value, scalars = loss(batch)
        norm = _descend(value, module, optimizer, config, step)
        if step % config.validate_every and step != config.steps:
            continue

        logged = {"loss": value.item(), "gradient_norm": norm.item(), **clock.rates(step, config)}
        logged |= {name: scalar.item() for name, scalar in scalars.items()}
        _require_finite(logged["loss"], f"{describe}: the loss", step)
        _require_finite(logged["gradient_norm"], f"{describe}: the gradient", step)
        if validate is None:
            counters["best_step"] = step
            save_tensors(best, module.state_dict(), {"step": step})
        else:
            logged["validation_loss"] = _keep_best(module, validate, counters, step, best, describe)
        log.add(step, logged)
        shown.update(0, loss=logged["loss"])
        counters |= {"step": step, "seconds": clock.total()}
        save_training(last, module, optimizer, counters)
        clock.restart(step)
    log.close()
    load_weights(best, module, load_tensors(best)[0])
    module.eval()
    best_validation = math.nan if validate is None else counters["best_validation"]
    return Fit(step, int(counters["best_step"]), best_validation, counters["seconds"])


def _steps(
    counters: Mapping[str, float], config: LoopConfig, describe: str
) -> Iterator[tuple[int, Progress]]:
    """Number the steps that are left until the end or an early stop, and show how fast they go."""
    step = int(counters["step"])
    with progress(config.steps, describe, "steps", step) as shown:
        while step < config.steps and not 0 < config.patience <= counters["stale"]:
            step += 1
            yield step, shown
            shown.update()


def _optimizer(module: nn.Module, config: LoopConfig) -> torch.optim.Optimizer:
    return torch.optim.AdamW(
        module.parameters(),
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
        fused=True,
    )


def _descend(
    value: Tensor,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    config: LoopConfig,
    step: int,
) -> Tensor:
    """One step down the gradient of `value`; returns the gradient's norm before clipping."""
    optimizer.zero_grad(set_to_none=True)
    value.backward()  # type: ignore[no-untyped-call]
    norm = nn.utils.clip_grad_norm_(module.parameters(), config.clip_norm or math.inf)
    for group in optimizer.param_groups:
        group["lr"] = _learning_rate(config, step)
    optimizer.step()
    return norm


class _Clock:
    """Time spent, and how much of it waiting for data."""

    def __init__(self, step: int, seconds: float) -> None:
        self._began = time.perf_counter() - seconds
        self.restart(step)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self._waited += time.perf_counter() - began

    def rates(self, step: int, config: LoopConfig) -> dict[str, float]:
        """Samples a second and the share of time waiting for data, since the last restart."""
        elapsed = time.perf_counter() - self._since
        return {
            "samples_per_second": (step - self._step) * config.batch_size / elapsed,
            "waiting_for_data": self._waited / elapsed,
        }

    def restart(self, step: int) -> None:
        """Count from here: what validation and checkpoints take is neither."""
        self._since, self._step, self._waited = time.perf_counter(), step, 0.0

    def total(self) -> float:
        return time.perf_counter() - self._began


def _learning_rate(config: LoopConfig, step: int) -> float:
    warm = min(1.0, step / max(1, config.warmup_steps))
    if not config.cosine or step < config.warmup_steps:
        return config.learning_rate * warm
    done = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
    return config.learning_rate * warm * (1 + math.cos(math.pi * done)) / 2


def _require_finite(value: float, what: str, step: int) -> None:
    if not math.isfinite(value):
        raise InputError(
            f"{what} is {value} at step {step}; lower the learning rate or "
            "look for extreme values in the store (`ucfrec prepare --validate`)"
        )


def _keep_best(
    module: nn.Module,
    validate: Callable[[], float],
    counters: dict[str, float],
    step: int,
    best: Path,
    describe: str,
) -> float:
    """Return the validation loss; if it is the lowest yet, save the weights and count from here."""
    module.eval()
    with torch.no_grad():
        loss = validate()
    _require_finite(loss, f"{describe}: the validation loss", step)
    if loss < counters["best_validation"]:
        counters |= {"best_validation": loss, "best_step": step, "stale": 0}
        save_tensors(best, module.state_dict(), {"step": step, "validation_loss": loss})
    else:
        counters["stale"] += 1
    return loss
