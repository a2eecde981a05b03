"""The training loop shared by reward model, generator and every policy."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

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
from ucfrec.processes import random_state_kept
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
    average: Annotated[float, Field(ge=0, lt=1)] = 0.999
    """Decay of an exponential moving average of the weights after the warm-up. It is validated and
    saved as the trained weights; 0 for the weights of the last step themselves."""


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


Watcher = Callable[[int, Mapping[str, float]], None]


@dataclass(frozen=True)
class Callbacks:
    """What is told of a training while it goes on, for any tracker of experiments.

    What one raises ends the training, which can be resumed. Of the processes of `torchrun`, only
    the leader's are called.
    """

    on_step: Watcher | None = None
    """Called after every update, with the step (from 1) and its `loss`."""
    on_validation: Watcher | None = None
    """Called after every validation, with the step and all that is logged: `validation_loss`,
    `loss`, `gradient_norm`, …"""

    def step(self, step: int, loss: Tensor) -> None:
        """Tell of an update."""
        if self.on_step is not None and distributed.leads():
            self.on_step(step, {"loss": loss.item()})

    def validation(self, step: int, logged: Mapping[str, float]) -> None:
        """Tell of a validation."""
        if self.on_validation is not None and distributed.leads():
            self.on_validation(step, logged)


SILENT: Final = Callbacks()


def step_generator(seed: int, step: int) -> np.random.Generator:
    """The generator for all random draws of one training step.

    It depends on nothing but `seed` and `step`, so a resumed training draws the same batches as an
    uninterrupted one.
    """
    return np.random.default_rng([seed, step])


def _seed_setter() -> Callable[[int], object]:
    """What seeds torch at every step.

    `torch.manual_seed` keeps a traceback of each call for every kind of accelerator that is not in
    use: without any, half a millisecond a step and memory for all of them.
    """
    if torch.accelerator.is_available():
        return torch.manual_seed
    return torch.default_generator.manual_seed


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
    callbacks: Callbacks = SILENT,
) -> Fit:
    """Minimise `loss` over batches from `draw`, resuming from `folder` if it holds a checkpoint.

    Writes `last.safetensors` (to resume), `best.safetensors` (weights with the lowest validation
    loss, else the last), `metrics.jsonl` and TensorBoard events to `folder`. A training killed and
    resumed ends with the weights of an uninterrupted one. The global random state is restored.

    Args:
        module: trained in place; holds the best weights on return.
        loss: the scalar to minimise, and scalars to log by name, of a batch.
        validate: the validation loss; called in evaluation mode without gradients.
        rows: number of rows of a batch that the loss is a mean of. With it, the processes of
            `torchrun` train together: each draws its part of every batch, and `validate` has to
            return the same everywhere.

    Raises:
        InputError: a loss or gradient is not finite, or a checkpoint is damaged or does not fit.
    """
    training = _Training(module, config, folder, describe)
    step = int(training.counters["step"])
    clock, log = _Clock(step, training.counters["seconds"]), _log(folder, step)
    set_seed = _seed_setter()
    joint, rank = rows if distributed.processes() > 1 else None, distributed.rank()
    module.train()
    for step, bar in _steps(training.counters, config, describe):
        generator = step_generator(seed, step)
        with clock.waiting():
            batch = draw(generator)
        set_seed(int(generator.integers(2**62)) + rank)
        if not module.training:  # a validation or a callback has ended it
            module.train()
        value, scalars = loss(batch)
        count = None if joint is None else joint(batch)
        norm = training.descend(value, step, count)
        callbacks.step(step, value)
        if step % config.validate_every and step != config.steps:
            continue
        logged = _means({"loss": value, **scalars}, count) | {"gradient_norm": norm.item()}
        logged |= clock.rates(step, config)
        logged |= training.validated(step, logged, validate, clock)
        if log is not None:
            log.add(step, logged)
            bar.update(0, loss=logged["loss"])
            training.save()
        callbacks.validation(step, logged)
        clock.restart(step)
    if log is not None:
        log.close()
    if joint is not None:
        distributed.wait()  # until the leader has written the best weights
    return training.end(step, validate is not None)


class _Training:
    """What a training changes, and the files that it is saved to and resumed from."""

    def __init__(self, module: nn.Module, config: LoopConfig, folder: Path, describe: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._last, self._best = folder / "last.safetensors", folder / "best.safetensors"
        self._module, self._config, self._describe = module, config, describe
        self._optimizer = RowAdamW(
            module.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        average, start = config.average, config.warmup_steps
        self._average = WeightAverage(module, average, start) if average else None
        self.counters: dict[str, float] = {
            "step": 0,
            "best_step": 0,
            "best_validation": math.inf,
            "stale": 0,
            "seconds": 0.0,
        }
        if self._last.exists():
            self.counters.update(load_training(self._last, module, self._optimizer, self._average))
        elif (initial := folder / INITIAL).exists():
            load_weights(initial, module, load_trained(initial))

    def descend(self, value: Tensor, step: int, count: float | None) -> Tensor:
        """One optimizer step on the loss `value`; returns the gradient norm before clipping.

        With `count`, the number of rows of `value`, on its mean over all processes.
        """
        self._optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        if count is not None:
            distributed.average_gradients(self._module.parameters(), count)
        norm = clip_gradients(self._module.parameters(), self._config.clip_norm)
        for group in self._optimizer.param_groups:
            group["lr"] = _learning_rate(self._config, step)
        moved = None if self._average is None else self._average.before_step()
        self._optimizer.step()
        if self._average is not None and moved is not None:
            self._average.after_step(moved)
        return norm

    def validated(
        self,
        step: int,
        logged: Mapping[str, float],
        validate: Callable[[], float] | None,
        clock: "_Clock",
    ) -> dict[str, float]:
        """Check and count what was logged of a step, and keep its weights if they are the best.

        Returns:
            The validation loss, for the log; empty without validation.
        """
        self._require_finite("loss", logged["loss"], step)
        self._require_finite("gradient", logged["gradient_norm"], step)
        validation = self._keep_best(validate, step)
        self.counters |= {"step": step, "seconds": clock.total()}
        return validation

    def _keep_best(self, validate: Callable[[], float] | None, step: int) -> dict[str, float]:
        """Save the weights if their validation loss is the lowest so far, or without validation."""
        with nullcontext() if self._average is None else self._average.applied():
            if validate is None:
                self.counters["best_step"] = step
                self._save_best({"step": step})
                return {}
            self._module.eval()
            with torch.no_grad():
                loss = validate()
            self._require_finite("validation loss", loss, step)
            if loss < self.counters["best_validation"]:
                self.counters |= {"best_validation": loss, "best_step": step, "stale": 0}
                self._save_best({"step": step, "validation_loss": loss})
            else:
                self.counters["stale"] += 1
            return {"validation_loss": loss}

    def _require_finite(self, quantity: str, value: float, step: int) -> None:
        if not math.isfinite(value):
            raise InputError(
                f"{self._describe}: the {quantity} is {value} at step {step}; lower the learning "
                "rate or look for extreme values in the store (`ucfrec prepare --validate`)"
            )

    def save(self) -> None:
        """Write what a resumption needs."""
        save_training(self._last, self._module, self._optimizer, self.counters, self._average)

    def end(self, step: int, validated: bool) -> Fit:
        """Load the best weights; returns the outcome, with the last `step`."""
        load_weights(self._best, self._module, load_tensors(self._best)[0])
        self._module.eval()
        lowest = self.counters["best_validation"] if validated else math.nan
        return Fit(step, int(self.counters["best_step"]), lowest, self.counters["seconds"])

    def _save_best(self, about: dict[str, float]) -> None:
        if distributed.leads():
            save_tensors(self._best, self._module.state_dict(), about)


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


class RowAdamW(torch.optim.AdamW):
    """AdamW; of parameters with sparse gradients, only the rows that take part are updated.

    Such a row is moved, decayed and its moments are renewed when it has a gradient, and is left
    alone otherwise, as in `torch.optim.SparseAdam`. So a step costs what its rows cost, however
    long the table. Dense gradients are AdamW's own.
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """One update; see `torch.optim.AdamW.step`."""
        for group in self.param_groups:
            for parameter in group["params"]:
                gradient = parameter.grad
                if gradient is not None and gradient.is_sparse:
                    self._update_rows(parameter, gradient.coalesce(), group)
                    parameter.grad = None
        return super().step(closure)

    def _update_rows(self, table: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        rows, values = gradient.indices()[0], gradient.values()
        state = self.state[table]
        if not state:
            state["step"] = torch.zeros((), device=table.device)
            state["exp_avg"] = torch.zeros_like(table)
            state["exp_avg_sq"] = torch.zeros_like(table)
        state["step"] += 1
        (first, second), count = group["betas"], float(state["step"])
        mean = state["exp_avg"][rows].lerp_(values, 1 - first)
        square = state["exp_avg_sq"][rows].mul_(second).addcmul_(values, values, value=1 - second)
        state["exp_avg"][rows] = mean
        state["exp_avg_sq"][rows] = square
        scale = square.div_(1 - second**count).sqrt_().add_(group["eps"])
        decayed = table[rows].mul_(1 - group["lr"] * group["weight_decay"])
        table[rows] = decayed.addcdiv_(mean, scale, value=-group["lr"] / (1 - first**count))


def clip_gradients(parameters: Iterable[nn.Parameter], largest: float) -> Tensor:
    """Scale the gradients so that their joint norm is at most `largest`, 0 for no limit.

    Sparse gradients are coalesced.
    """
    gradients = []
    for parameter in parameters:
        if parameter.grad is None:
            continue
        if parameter.grad.is_sparse:
            parameter.grad = parameter.grad.coalesce()
            gradients.append(parameter.grad.values())
        else:
            gradients.append(parameter.grad)
    norm = nn.utils.get_total_norm(gradients)
    if largest:
        torch._foreach_mul_(gradients, torch.clamp(largest / (norm + 1e-6), max=1.0))
    return norm
