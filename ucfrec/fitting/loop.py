"""The training loop shared by reward model, generator and every policy."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal, TypeVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.errors import InputError
from ucfrec.files.record import Undefinable
from ucfrec.fitting import distributed
from ucfrec.fitting.average import WeightAverage
from ucfrec.fitting.checkpoint import (
    load_tensors,
    load_trained,
    load_training,
    load_weights,
    save_tensors,
    save_training,
)
from ucfrec.fitting.metrics_log import MetricsLog
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.fitting.row_optimizer import RowAdamW, clip_gradients
from ucfrec.progress import Progress, no_progress, progress
from ucfrec.settings import BatchSize, Count, LearningRate, WeightDecay, settings_table

Batch = TypeVar("Batch")
INITIAL: Final = "initial.safetensors"
"""File of the weights that a training begins with, in its folder, if it is there."""


@settings_table("train")
class LoopConfig:
    """Length of a training and settings of its optimizer (AdamW).

    The defaults are those of policies in the paper's Table 8; settings that it does not give, such
    as `steps`, are our choice.
    """

    steps: Count = 10_000
    """Number of updates."""
    batch_size: BatchSize = 64
    """Windows per update."""
    learning_rate: LearningRate = 1e-4
    """Learning rate after the warm-up."""
    weight_decay: WeightDecay = 1e-4
    """Weight decay of AdamW."""
    warmup_steps: Annotated[int, Field(ge=0, le=10**12)] = 500
    """Steps over which the learning rate rises linearly from 0 to `learning_rate`; a training with
    fewer steps ends before it reaches that."""
    cosine: bool = False
    """After the warm-up, lower the learning rate along a cosine, to 0 at the last step, instead of
    keeping it constant."""
    clip_norm: Annotated[float, Field(ge=0, le=1e6)] = 0.25
    """Norm to which larger gradients are clipped; 0 disables clipping."""
    validate_every: Count = 500
    """Steps between validations, checkpoints and log lines."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Numbers in which the policy's products are computed; `bfloat16` is for GPUs. Weights, losses
    and optimizer are float32 with both."""
    patience: Annotated[int, Field(ge=0, le=10**9)] = 0
    """Number of consecutive validations without improvement after which training stops early; 0
    disables early stopping."""
    average: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Decay of an exponential moving average of the weights, which is validated and saved as the
    trained weights; 0 for the weights of the last step themselves."""


@dataclass(frozen=True)
class Fit:
    """The outcome of a training."""

    steps: int
    """Last step, which early stopping can put before `LoopConfig.steps`."""
    best_step: int
    """Step of the weights with the lowest validation loss; the last without validation."""
    best_validation: Undefinable
    """Lowest validation loss; NaN without validation."""
    seconds: float
    """Wall-clock time up to the last checkpoint, summed over all resumptions."""


def step_generator(seed: int, step: int) -> np.random.Generator:
    """The generator for all random draws of one training step.

    It depends on nothing but `seed` and `step`, so a resumed training draws the same batches as an
    uninterrupted one.
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
    rows: Callable[[Batch], float] | None = None,
) -> Fit:
    """Minimise `loss` over batches from `draw`, resuming from `folder` if it holds a checkpoint.

    With `config.average`, what is validated and saved as the trained weights is their average.
    Writes `last.safetensors` (to resume), `best.safetensors` (weights with the lowest validation
    loss, else the last), `metrics.jsonl` and TensorBoard events to `folder`. A training killed and
    resumed ends with the weights of an uninterrupted one. The global random state is restored.

    Args:
        module: trained in place; holds the best weights on return.
        draw: draws a batch with the given generator.
        loss: the scalar to minimise, and scalars to log by name, of a batch.
        validate: the validation loss; called in evaluation mode without gradients.
        describe: name of the training in progress and error messages.
        rows: number of rows of a batch that the loss is a mean of. With it, the processes of
            `torchrun` train together: each draws its part of every batch, gradients and logged
            scalars are means over all rows, and `validate` has to return the same everywhere.

    Raises:
        InputError: a loss or gradient is not finite, or a checkpoint is damaged or does not fit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    last, best = folder / "last.safetensors", folder / "best.safetensors"
    initial = folder / INITIAL
    optimizer = _optimizer(module, config)
    average = WeightAverage(module, config.average) if config.average else None
    counters = {"step": 0, "best_step": 0, "best_validation": math.inf, "stale": 0, "seconds": 0.0}
    if last.exists():
        counters.update(load_training(last, module, optimizer, average))
    elif initial.exists():
        load_weights(initial, module, load_trained(initial))
    step = int(counters["step"])
    clock, log = _Clock(step, counters["seconds"]), _log(folder, step)
    joint = rows if distributed.processes() > 1 else None
    for step, bar in _steps(counters, config, describe):
        generator = step_generator(seed, step)
        with clock.waiting():
            batch = draw(generator)
        torch.manual_seed(int(generator.integers(2**62)) + distributed.rank())
        module.train()
        value, scalars = loss(batch)
        count = None if joint is None else joint(batch)
        norm = _descend(value, module, optimizer, average, config, step, count)
        if step % config.validate_every and step != config.steps:
            continue
        means = _means({"loss": value, **scalars}, count)
        logged = {"loss": means["loss"], "gradient_norm": norm.item(), **clock.rates(step, config)}
        _require_finite(logged["loss"], f"{describe}: the loss", step)
        _require_finite(logged["gradient_norm"], f"{describe}: the gradient", step)
        with nullcontext() if average is None else average.applied():
            logged |= means | _keep_best(module, validate, counters, step, best, describe)
        counters |= {"step": step, "seconds": clock.total()}
        if log is not None:
            log.add(step, logged)
            bar.update(0, loss=logged["loss"])
            save_training(last, module, optimizer, counters, average)
        clock.restart(step)
    if log is not None:
        log.close()
    if joint is not None:
        distributed.wait()  # until the leader has written the best weights
    load_weights(best, module, load_tensors(best)[0])
    module.eval()
    lowest = math.nan if validate is None else counters["best_validation"]
    return Fit(step, int(counters["best_step"]), lowest, counters["seconds"])


def _means(scalars: Mapping[str, Tensor], count: float | None) -> dict[str, float]:
    """Scalars of a batch; with `count`, its rows here, their means over all processes."""
    values = {name: scalar.item() for name, scalar in scalars.items()}
    return values if count is None else distributed.joint_means(values, count)


def _log(folder: Path, step: int) -> MetricsLog | None:
    """The log of the training; none for a process that is not the leader."""
    return MetricsLog(folder, step) if distributed.leads() else None


def _steps(
    counters: Mapping[str, float], config: LoopConfig, describe: str
) -> Iterator[tuple[int, Progress]]:
    """Yield the remaining steps, until the last or an early stop, with their progress display."""
    step = int(counters["step"])
    display = progress if distributed.leads() else no_progress
    with display(config.steps, describe, "steps", step) as bar:
        while step < config.steps and not 0 < config.patience <= counters["stale"]:
            step += 1
            yield step, bar
            bar.update()


def _optimizer(module: nn.Module, config: LoopConfig) -> torch.optim.Optimizer:
    return RowAdamW(
        module.parameters(),
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
        fused=True,
    )


def _descend(
    value: Tensor,
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    average: WeightAverage | None,
    config: LoopConfig,
    step: int,
    count: float | None,
) -> Tensor:
    """One optimizer step on the loss `value`; returns the gradient norm before clipping.

    With `count`, the number of rows of `value`, on its mean over all processes.
    """
    optimizer.zero_grad(set_to_none=True)
    value.backward()  # type: ignore[no-untyped-call]
    if count is not None:
        distributed.average_gradients(module.parameters(), count)
    norm = clip_gradients(module.parameters(), config.clip_norm)
    for group in optimizer.param_groups:
        group["lr"] = _learning_rate(config, step)
    moved = None if average is None else average.before_step()
    optimizer.step()
    if average is not None and moved is not None:
        average.after_step(moved)
    return norm


class _Clock:
    """Measures training time and the share of it spent waiting for data."""

    def __init__(self, step: int, seconds: float) -> None:
        self._start = time.perf_counter() - seconds
        self.restart(step)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._waited += time.perf_counter() - start

    def rates(self, step: int, config: LoopConfig) -> dict[str, float]:
        """Samples per second and share of time spent waiting for data, since the last restart."""
        elapsed = time.perf_counter() - self._interval_start
        return {
            "samples_per_second": (step - self._step) * config.batch_size / elapsed,
            "waiting_for_data": self._waited / elapsed,
        }

    def restart(self, step: int) -> None:
        """Start a new interval for `rates`, which thus excludes validations and checkpoints."""
        self._interval_start, self._step, self._waited = time.perf_counter(), step, 0.0

    def total(self) -> float:
        """Seconds since the training began, including earlier processes."""
        return time.perf_counter() - self._start


def _learning_rate(config: LoopConfig, step: int) -> float:
    warmup = min(1.0, step / max(1, config.warmup_steps))
    if not config.cosine or step < config.warmup_steps:
        return config.learning_rate * warmup
    done = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
    return config.learning_rate * warmup * (1 + math.cos(math.pi * done)) / 2


def _require_finite(value: float, quantity: str, step: int) -> None:
    if not math.isfinite(value):
        raise InputError(
            f"{quantity} is {value} at step {step}; lower the learning rate or "
            "look for extreme values in the store (`ucfrec prepare --validate`)"
        )


def _keep_best(
    module: nn.Module,
    validate: Callable[[], float] | None,
    counters: dict[str, float],
    step: int,
    best: Path,
    describe: str,
) -> dict[str, float]:
    """Save the weights if their validation loss is the lowest so far, or without validation.

    Returns:
        The validation loss, for the log; empty without validation.
    """
    if validate is None:
        counters["best_step"] = step
        _save_best(best, module, {"step": step})
        return {}
    module.eval()
    with torch.no_grad():
        loss = validate()
    _require_finite(loss, f"{describe}: the validation loss", step)
    if loss < counters["best_validation"]:
        counters |= {"best_validation": loss, "best_step": step, "stale": 0}
        _save_best(best, module, {"step": step, "validation_loss": loss})
    else:
        counters["stale"] += 1
    return {"validation_loss": loss}


def _save_best(best: Path, module: nn.Module, about: dict[str, float]) -> None:
    if distributed.leads():
        save_tensors(best, module.state_dict(), about)
