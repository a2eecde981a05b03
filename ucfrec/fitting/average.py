"""An exponential moving average of the weights of a training."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final

import torch
from torch import Tensor, nn

PREFIX: Final = "average."
"""Start of the names of averages in a checkpoint."""
_WHEN: Final = ".when"
"""End of the name of when each row of a table was last averaged."""


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

    def __init__(self, module: nn.Module, decay: float, start: int = 0) -> None:
        """
        Args:
            module: averaged from its present weights on, which then change in place.
            decay: the largest d, above 0 and below 1.
            start: steps whose weights are not averaged.
        """
        self._decay, self._start, self._step = decay, start, 0
        self._log = 0.0  # Σ log d of the steps so far
        # A checkpoint has shared weights once for each name, so their averages are, too.
        self._gradients = dict(module.named_parameters(remove_duplicate=False))
        self._weights = {name: each.detach() for name, each in self._gradients.items()}
        self._means = {name: weights.clone() for name, weights in self._weights.items()}
        self._when: dict[str, Tensor] = {}  # `_log` at the last average of each row of a table

    def before_step(self) -> dict[str, Tensor]:
        """Bring the averages of rows that the next step moves up to date; returns them by table.

        To be called once gradients are known, and before weights move.
        """
        moved = {}
        for name, parameter in self._gradients.items():
            gradient = parameter.grad
            if gradient is not None and gradient.is_sparse:
                rows = moved[name] = gradient.coalesce().indices()[0]
                if name not in self._when:
                    whole = torch.full((len(parameter),), self._log, dtype=torch.float64)
                    self._when[name] = whole.to(rows.device)
                self._means[name][rows] = _rested(
                    self._means[name][rows],
                    self._weights[name][rows],
                    self._log - self._when[name][rows],
                )
        return moved

    def after_step(self, moved: Mapping[str, Tensor]) -> None:
        """Average the weights after a step; `moved` is what `before_step` returned."""
        self._step += 1
        t = max(0, self._step - self._start)
        decay = min(self._decay, t / (9 + t))
        if decay:  # otherwise the averages are the weights, also of rows that rest
            self._log += math.log(decay)
        for name, rows in moved.items():
            self._means[name][rows] = self._means[name][rows].lerp_(
                self._weights[name][rows], 1 - decay
            )
            self._when[name][rows] = self._log
        dense = [name for name in self._means if name not in self._when]
        torch._foreach_lerp_(
            [self._means[name] for name in dense],
            [self._weights[name] for name in dense],
            1 - decay,
        )

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Inside, the module's weights are the averages."""
        kept = {name: weights.clone() for name, weights in self._weights.items()}
        tensors, counters = self.state()
        self._put(averages(tensors, kept, counters))
        try:
            yield
        finally:
            self._put(kept)

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Named tensors and counters, for `restore`."""
        when = {f"{name}{_WHEN}": table for name, table in self._when.items()}
        tensors = {f"{PREFIX}{name}": table for name, table in {**self._means, **when}.items()}
        return tensors, {"averaged_steps": self._step, "average_log": self._log}

    def restore(self, tensors: Mapping[str, Tensor], counters: Mapping[str, float]) -> None:
        """Go on from what `state` returned.

        Raises:
            KeyError, RuntimeError: an average is missing, or has another shape.
        """
        self._step, self._log = int(counters["averaged_steps"]), float(counters["average_log"])
        for name, mean in self._means.items():
            mean.copy_(tensors[f"{PREFIX}{name}"])
            if (when := tensors.get(f"{PREFIX}{name}{_WHEN}")) is not None:
                self._when[name] = when.to(mean.device)

    def _put(self, values: Mapping[str, Tensor]) -> None:
        for name, weights in self._weights.items():
            weights.copy_(values[name])


def averages(
    tensors: Mapping[str, Tensor], weights: Mapping[str, Tensor], counters: Mapping[str, float]
) -> dict[str, Tensor]:
    """Averages by the names of their weights, every row of a table brought up to date.

    Args:
        tensors: of `WeightAverage.state`; others are ignored.
        counters: of `WeightAverage.state`.
    """
    means = {}
    for name, table in weights.items():
        if (mean := tensors.get(f"{PREFIX}{name}")) is not None:
            when = tensors.get(f"{PREFIX}{name}{_WHEN}")
            rest = None if when is None else counters["average_log"] - when
            means[name] = mean if rest is None else _rested(mean, table, rest)
    return means


def _rested(means: Tensor, weights: Tensor, unnamed: Tensor) -> Tensor:
    """Averages of rows (M, …) that rested for steps with Σ log d = `rest` (M,)."""
    share = unnamed.exp().to(means.dtype).view(-1, *[1] * (means.dim() - 1))
    return torch.where(share < 1, torch.lerp(weights, means, share), means)
