"""The training loop shared by reward model, generator and every policy."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.errors import InputError, damage_explained
from ucfrec.files.record import Undefinable
from ucfrec.fitting import distributed
from ucfrec.fitting.checkpoint import REMEDY, MetricsLog, load_tensors, load_weights, save_tensors
from ucfrec.processes import progress, random_state_kept
from ucfrec.settings import BatchSize, Count, LearningRate, WeightDecay, settings_table

Batch = TypeVar("Batch")
_OPTIMIZER = "optimizer."
_AVERAGE = "average."
"""Start of the names of averages in a checkpoint."""
_WHEN = ".when"
"""End of the name of when each row of a table was last averaged."""


@settings_table("train")
class LoopConfig:
    """Length of a training and settings of its optimizer (AdamW).

    The defaults are for policies of items; those of the paper's Table 8 are presets of `ucf-paper`
    and of control.
    """

    steps: Count = 10_000
    """Number of updates."""
    batch_size: BatchSize = 64
    """Windows per update."""
    learning_rate: LearningRate = 1e-3
    """Learning rate after the warm-up."""
    weight_decay: WeightDecay = 1e-4
    """Weight decay of AdamW."""
    warmup_steps: Annotated[int, Field(ge=0, le=10**12)] | None = None
    """Steps over which the learning rate rises linearly from 0 to `learning_rate`; unset for a
    twentieth of all, at most 500."""
    cosine: bool = False
    """After the warm-up, lower the learning rate along a cosine, to 0 at the last step, instead of
    keeping it constant."""
    clip_norm: Annotated[float, Field(ge=0, le=1e6)] = 0.25
    """Norm to which larger gradients are clipped; 0 disables clipping."""
    validate_every: Count = 200
    """Steps between validations, checkpoints and log lines."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Numbers in which the policy's products are computed; `bfloat16` is for GPUs and for CPUs with
    avx512_bf16 or AMX. Weights, losses and optimizer are float32 with both."""
    patience: Annotated[int, Field(ge=0, le=10**9)] = 5
    """Number of consecutive validations without improvement after which training stops early; 0
    disables early stopping."""
    average: Annotated[float, Field(ge=0, lt=1)] = 0.999
    """Decay of an exponential moving average of the weights after the warm-up. It is validated and
    saved as the trained weights; 0 for the weights of the last step themselves."""

    @property
    def warmup(self) -> int:
        """Steps of the warm-up."""
        return min(500, self.steps // 20) if self.warmup_steps is None else self.warmup_steps


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


SILENT = Callbacks()


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
    counters, step = training.counters, int(training.counters["step"])
    started = time.perf_counter() - counters["seconds"]
    log = MetricsLog(folder, step) if distributed.leads() else None
    # `torch.manual_seed` keeps a traceback of each call for every kind of accelerator that is not
    # in use: without any, half a millisecond a step and memory for all of them.
    accelerated = torch.accelerator.is_available()
    set_seed = torch.manual_seed if accelerated else torch.default_generator.manual_seed
    joint, rank = rows if distributed.processes() > 1 else None, distributed.rank()
    module.train()
    # Of the interval since the last validation: its start, its first step, seconds without a batch.
    since, since_step, waited = time.perf_counter(), step, 0.0
    with progress(config.steps, describe, "steps", step, shown=log is not None) as bar:
        while step < config.steps and not 0 < config.patience <= counters["stale"]:
            step += 1
            # A function of seed and step, so that a resumed training draws the same batches.
            generator = np.random.default_rng([seed, step])
            asked_at = time.perf_counter()
            batch = draw(generator)
            waited += time.perf_counter() - asked_at
            set_seed(int(generator.integers(2**62)) + rank)
            if not module.training:  # a validation or a callback has ended it
                module.train()
            value, scalars = loss(batch)
            count = None if joint is None else joint(batch)
            norm = training.descend(value, step, count)
            if callbacks.on_step is not None and log is not None:
                callbacks.on_step(step, {"loss": value.item()})
            if step % config.validate_every == 0 or step == config.steps:
                means = {name: scalar.item() for name, scalar in {"loss": value, **scalars}.items()}
                if count is not None:
                    means = distributed.joint_means(means, count)
                elapsed = time.perf_counter() - since
                logged = means | {
                    "gradient_norm": norm.item(),
                    "samples_per_second": (step - since_step) * config.batch_size / elapsed,
                    "waiting_for_data": waited / elapsed,
                }
                logged |= training.validate(step, logged, validate)
                counters |= {"step": step, "seconds": time.perf_counter() - started}
                if log is not None:
                    log.add(step, logged)
                    bar.set_postfix(loss=logged["loss"], refresh=False)
                    training.save()
                    if callbacks.on_validation is not None:
                        callbacks.on_validation(step, logged)
                since, since_step, waited = time.perf_counter(), step, 0.0
            bar.update()
    if log is not None:
        log.close()
    if joint is not None:
        distributed.wait()  # until the leader has written the best weights
    return training.end(step, validate is not None)


class _Training:
    """What a training changes, and the files that it is saved to and resumed from."""

    def __init__(
        self,
        module: nn.Module,
        config: LoopConfig,
        folder: Path,
        describe: str,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._last, self._best = folder / "last.safetensors", folder / "best.safetensors"
        self._module, self._config, self._describe = module, config, describe
        rate, decay = config.learning_rate, config.weight_decay
        self._optimizer = RowAdamW(module.parameters(), lr=rate, weight_decay=decay, fused=True)
        self._average = None
        if config.average:
            self._average = WeightAverage(module, config.average, config.warmup)
        self.counters: dict[str, float] = {"step": 0, "best_step": 0, "stale": 0, "seconds": 0.0}
        self.counters["best_validation"] = math.inf
        if self._last.exists():
            self._resume()

    def _resume(self) -> None:
        tensors, counters = load_tensors(self._last)
        state: dict[int, dict[str, Tensor]] = {}
        means = {name: tensors.pop(name) for name in [*tensors] if name.startswith(_AVERAGE)}
        with damage_explained(self._last, REMEDY):
            for name in [name for name in tensors if name.startswith(_OPTIMIZER)]:
                index, key = name.removeprefix(_OPTIMIZER).split(".")
                state.setdefault(int(index), {})[key] = tensors.pop(name)
            load_weights(self._last, self._module, tensors)
            groups = self._optimizer.state_dict()["param_groups"]
            self._optimizer.load_state_dict({"state": state, "param_groups": groups})
            if self._average is not None:
                self._average.restore(means, counters)
            self.counters |= {name: counters[name] for name in self.counters}

    def save(self) -> None:
        """Write what a resumption needs: weights, their averages, optimizer state and counters."""
        tensors, counters = dict(self._module.state_dict()), dict(self.counters)
        for index, moments in self._optimizer.state_dict()["state"].items():
            for key, value in moments.items():
                tensors[f"{_OPTIMIZER}{index}.{key}"] = value
        if self._average is not None:
            means, steps = self._average.state()
            tensors, counters = tensors | means, counters | steps
        save_tensors(self._last, tensors, counters)

    def descend(
        self,
        value: Tensor,
        step: int,
        count: float | None,
    ) -> Tensor:
        """One optimizer step on the loss `value`, the mean of `count` rows of all that processes
        have; returns the gradient norm before clipping."""
        config = self._config
        self._optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        if count is not None:
            distributed.average_gradients(self._module.parameters(), count)
        norm = clip_gradients(self._module.parameters(), config.clip_norm)
        rate = config.learning_rate * min(1.0, step / max(1, config.warmup))
        if config.cosine and step >= config.warmup:
            done = (step - config.warmup) / max(1, config.steps - config.warmup)
            rate = rate * (1 + math.cos(math.pi * done)) / 2
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        moved = None if self._average is None else self._average.before_step()
        self._optimizer.step()
        if self._average is not None and moved is not None:
            self._average.after_step(moved)
        return norm

    def validate(
        self,
        step: int,
        logged: Mapping[str, float],
        validate: Callable[[], float] | None,
    ) -> dict[str, float]:
        """Save the weights if their validation loss, which is returned, is the lowest so far."""
        self._require_finite("loss", logged["loss"], step)
        self._require_finite("gradient", logged["gradient_norm"], step)
        losses = {}
        with nullcontext() if self._average is None else self._average.apply():
            if validate is not None:
                self._module.eval()
                with torch.no_grad():
                    losses["validation_loss"] = loss = validate()
                self._require_finite("validation loss", loss, step)
                if loss >= self.counters["best_validation"]:
                    self.counters["stale"] += 1
                    return losses
                self.counters |= {"best_validation": loss, "stale": 0}
            self.counters["best_step"] = step
            if distributed.leads():
                save_tensors(self._best, self._module.state_dict(), {"step": step, **losses})
        return losses

    def _require_finite(
        self,
        quantity: str,
        value: float,
        step: int,
    ) -> None:
        if not math.isfinite(value):
            raise InputError(
                f"{self._describe}: the {quantity} is {value} at step {step}; lower the learning "
                "rate or look for extreme values in the store (`ucfrec prepare --validate`)"
            )

    def end(self, step: int, validated: bool) -> Fit:
        """Load the best weights; returns the outcome, with the last `step`."""
        load_weights(self._best, self._module, load_tensors(self._best)[0])
        self._module.eval()
        lowest = self.counters["best_validation"] if validated else math.nan
        return Fit(step, int(self.counters["best_step"]), lowest, self.counters["seconds"])


def load_trained(path: Path) -> dict[str, Tensor]:
    """The trained weights in a file of `fit`: averages where it has them, and nothing else;
    InputError if it is missing or damaged."""
    tensors, counters = load_tensors(path)
    weights = {n: t for n, t in tensors.items() if not n.startswith((_OPTIMIZER, _AVERAGE))}
    with damage_explained(path, REMEDY):
        return weights | _averages(tensors, weights, counters)


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

    def _update_rows(
        self,
        table: Tensor,
        gradient: Tensor,
        group: dict[str, Any],
    ) -> None:
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
        gradient = parameter.grad
        if gradient is not None and gradient.is_sparse:
            parameter.grad = gradient.coalesce()
            gradient = parameter.grad.values()
        if gradient is not None:
            gradients.append(gradient)
    norm = nn.utils.get_total_norm(gradients)
    if largest:
        torch._foreach_mul_(gradients, torch.clamp(largest / (norm + 1e-6), max=1.0))
    return norm


class WeightAverage:
    """The mean θ̄ of a module's weights θ over its steps: θ̄ₜ = dₜ θ̄ₜ₋₁ + (1 − dₜ) θₜ.

    dₜ = min(decay, t / (9 + t)), with t counted from the end of the learning rate's warm-up, and 0
    before, so that a short training is not held back by its first weights. Buffers are not
    averaged.

    Of a table with sparse gradients, a step averages the rows that it moves. While a row rests, its
    average approaches it by the product of the steps' d, which is applied when the row moves again
    or is read. What is stored depends only on the steps, not on when averages were read, so a
    resumed training ends with the bits of an uninterrupted one.
    """

    def __init__(
        self,
        module: nn.Module,
        decay: float,
        start: int = 0,
    ) -> None:
        """`decay` is the largest d; the weights of the first `start` steps are not averaged."""
        self._decay, self._start, self._step = decay, start, 0
        self._log = 0.0  # Σ log d of the steps so far
        # A checkpoint has shared weights once for each name, so their averages are, too.
        self._gradients = dict(module.named_parameters(remove_duplicate=False))
        self._weights = {name: weights.detach() for name, weights in self._gradients.items()}
        self._means = {name: weights.clone() for name, weights in self._weights.items()}
        self._when: dict[str, Tensor] = {}  # `_log` at the last average of each row of a table

    def before_step(self) -> dict[str, Tensor]:
        """Bring the averages of rows that the gradients will move up to date; returns the rows."""
        moved = {}
        for name, parameter in self._gradients.items():
            gradient = parameter.grad
            if gradient is not None and gradient.is_sparse:
                rows = moved[name] = gradient.coalesce().indices()[0]
                if name not in self._when:
                    whole = torch.full((len(parameter),), self._log, dtype=torch.float64)
                    self._when[name] = whole.to(rows.device)
                means, rested = self._means[name], self._log - self._when[name][rows]
                means[rows] = _age_rows(means[rows], self._weights[name][rows], rested)
        return moved

    def after_step(self, moved: Mapping[str, Tensor]) -> None:
        """Average the weights after a step; `moved` is what `before_step` returned."""
        self._step += 1
        t = max(0, self._step - self._start)
        decay = min(self._decay, t / (9 + t))
        if decay:  # otherwise the averages are the weights, also of rows that rest
            self._log += math.log(decay)
        for name, rows in moved.items():
            means = self._means[name]
            means[rows] = means[rows].lerp_(self._weights[name][rows], 1 - decay)
            self._when[name][rows] = self._log
        dense = [name for name in self._means if name not in self._when]
        dense_means = [self._means[name] for name in dense]
        torch._foreach_lerp_(dense_means, [self._weights[name] for name in dense], 1 - decay)

    @contextmanager
    def apply(self) -> Iterator[None]:
        """Inside, the module's weights are the averages."""
        own_weights = {name: weights.clone() for name, weights in self._weights.items()}
        tensors, counters = self.state()
        try:
            for name, mean in _averages(tensors, own_weights, counters).items():
                self._weights[name].copy_(mean)
            yield
        finally:
            for name, weights in own_weights.items():
                self._weights[name].copy_(weights)

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Named tensors and counters, for `restore`."""
        when = {f"{name}{_WHEN}": table for name, table in self._when.items()}
        tensors = {f"{_AVERAGE}{name}": table for name, table in {**self._means, **when}.items()}
        return tensors, {"averaged_steps": self._step, "average_log": self._log}

    def restore(self, tensors: Mapping[str, Tensor], counters: Mapping[str, float]) -> None:
        """Go on from what `state` returned; KeyError or RuntimeError if it is damaged."""
        self._step, self._log = int(counters["averaged_steps"]), float(counters["average_log"])
        for name, mean in self._means.items():
            mean.copy_(tensors[f"{_AVERAGE}{name}"])
            if (when := tensors.get(f"{_AVERAGE}{name}{_WHEN}")) is not None:
                self._when[name] = when.to(mean.device)


def _averages(
    tensors: Mapping[str, Tensor], weights: Mapping[str, Tensor], counters: Mapping[str, float]
) -> dict[str, Tensor]:
    """Averages of `WeightAverage.state` by names of weights, every row brought up to date."""
    means = {}
    for name, table in weights.items():
        mean, when = (tensors.get(f"{_AVERAGE}{name}{end}") for end in ("", _WHEN))
        if mean is not None and when is not None:
            mean = _age_rows(mean, table, counters["average_log"] - when)
        if mean is not None:
            means[name] = mean
    return means


def _age_rows(means: Tensor, weights: Tensor, log_shares: Tensor) -> Tensor:
    """Averages of rows (M, …) that rested for steps with Σ log d = `log_shares` (M,)."""
    shape = [-1] + [1] * (means.dim() - 1)
    share = log_shares.exp().to(means.dtype).view(shape)
    return torch.where(share < 1, torch.lerp(weights, means, share), means)
