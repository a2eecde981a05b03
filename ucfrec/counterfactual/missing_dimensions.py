"""Predictions of the next state and of the reward with some dimensions of the state missing."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.arrays import IntArray
from ucfrec.counterfactual.measured_reward import (
    CLIP,
    held_out_of,
    standardised,
    steps_with_successor,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.progress import progress

CHUNK: Final = 1024
"""Transitions whose errors are computed at once."""


@dataclass(frozen=True)
class StandardSteps:
    """Standardised steps that have a successor."""

    states: Tensor
    """(N, S)."""
    actions: Tensor
    rewards: Tensor
    """(N, 1)."""
    changes: Tensor
    """(N, S) of the state until the next step."""
    episodes: IntArray
    held_out: Any
    """(N,) bool."""

    @property
    def moving(self) -> Tensor:
        """(S,) whether a dimension ever changes within an episode."""
        return self.changes.abs().amax(0) > 0

    @classmethod
    def of(cls, view: EpisodeStore, most: int, seed: int) -> "StandardSteps":
        episodes, steps = steps_with_successor(view, most, seed)
        transitions = view.transitions(episodes, steps)
        mean, std = view.state_statistics
        states = (transitions.states - mean) / torch.where(std > 1e-6, std, 1.0)
        next_states = (transitions.next_states - mean) / torch.where(std > 1e-6, std, 1.0)
        return cls(
            states=states.clamp(-CLIP, CLIP),
            actions=standardised(transitions.actions),
            rewards=standardised(transitions.rewards.unsqueeze(1)),
            changes=standardised(next_states - states),
            episodes=episodes,
            held_out=held_out_of(view, episodes),
        )


class _Predictors(nn.Module):
    """M perceptrons of one shape, side by side."""

    def __init__(self, sizes: Sequence[int], count: int = 1) -> None:
        super().__init__()
        self.sizes = sizes
        pairs = list(pairwise(sizes))
        self.weights = nn.ParameterList(torch.randn(count, i, o) / i**0.5 for i, o in pairs)
        self.biases = nn.ParameterList(torch.zeros(count, 1, o) for _, o in pairs)

    def forward(self, inputs: Tensor) -> Tensor:
        """(M, B, in) to (M, B, out)."""
        hidden = inputs
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, nn.functional.silu(hidden) if layer else hidden, weight)
        return hidden

    def repeated(self, count: int) -> "_Predictors":
        """`count` copies of a single perceptron."""
        copies = _Predictors(self.sizes, count)
        with torch.no_grad():
            for copy, original in zip(copies.parameters(), self.parameters(), strict=True):
                copy.copy_(original.expand_as(copy))
        return copies


class PredictorPair(nn.Module):
    """Predictors of the next state, the reward given, and of the reward, dimensions missing."""

    def __init__(self, next_state: _Predictors, reward: _Predictors) -> None:
        super().__init__()
        self.next_state, self.reward = next_state, reward

    def errors(self, data: StandardSteps, rows: Tensor, missing: Tensor) -> tuple[Tensor, Tensor]:
        """Squared errors (M, B, S) and (M, B); `missing` (M, 1 or B, S) is 1 where missing."""
        missing = missing.expand(-1, len(rows), -1)

        def spread(values: Tensor) -> Tensor:
            return values[rows].expand(len(missing), -1, -1)

        inputs = torch.cat([data.states[rows] * (1 - missing), missing, spread(data.actions)], 2)
        with_reward = torch.cat([inputs, spread(data.rewards)], 2)
        next_errors = (self.next_state(with_reward) - data.changes[rows]).square()
        return next_errors, (self.reward(inputs) - data.rewards[rows]).square().squeeze(2)


def absences_of(data: StandardSteps, missing: Sequence[Collection[int]]) -> Tensor:
    """(M, 1, S): row m misses the dimensions `missing[m]`."""
    absences = torch.zeros(len(missing), 1, data.states.shape[1])
    for row, dimensions in enumerate(missing):
        absences[row, 0, list(dimensions)] = 1.0
    return absences


def shared_pair(
    data: StandardSteps, width: int, steps: int, batch_size: int, learning_rate: float
) -> PredictorPair:
    """A pair of predictors that serves every missing dimension.

    Args:
        data: steps, of which those held out are not seen.
    """
    size = data.states.shape[1]
    inputs = 2 * size + data.actions.shape[1]
    pair = PredictorPair(
        _Predictors((inputs + 1, width, width, size)), _Predictors((inputs, width, width, 1))
    )
    absences = absences_of(data, [*((dimension,) for dimension in range(size)), ()])[:, 0]

    def some_missing() -> Tensor:
        # A third of the rows miss nothing, so that the complete predictor is not the worst trained.
        rows = torch.randint(3 * size // 2 + 1, (batch_size,)).clamp(max=size)
        return absences[rows].unsqueeze(0)

    _optimise(pair, data, some_missing, steps, batch_size, learning_rate, "screening, common")
    return pair


def own_pairs(
    shared: PredictorPair,
    data: StandardSteps,
    absences: Tensor,
    steps: int,
    batch_size: int,
    learning_rate: float,
) -> PredictorPair:
    """A copy of the shared pair for each row of `absences`, fitted further.

    Args:
        shared: of `shared_pair`.
        data, steps, batch_size, learning_rate: as of `shared_pair`.
        absences: of `absences_of`.
    """
    count = len(absences)
    pair = PredictorPair(shared.next_state.repeated(count), shared.reward.repeated(count))
    describe = f"screening, {count} cases"
    _optimise(pair, data, lambda: absences, steps, batch_size, learning_rate, describe)
    return pair


def _optimise(
    pair: PredictorPair,
    data: StandardSteps,
    missing: Callable[[], Tensor],
    steps: int,
    batch_size: int,
    learning_rate: float,
    describe: str,
) -> None:
    rows = torch.from_numpy(np.flatnonzero(~data.held_out))
    optimizer = torch.optim.Adam(pair.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, steps)
    with progress(steps, describe, "steps") as bar:
        for _ in range(steps):
            absent = missing()
            batch = rows[torch.randint(len(rows), (batch_size,))]
            next_errors, reward_errors = pair.errors(data, batch, absent)
            # A missing dimension's own future is not part of the rest.
            loss = (next_errors * (1 - absent)).mean((1, 2)).sum() + reward_errors.mean(1).sum()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
            bar.update()


@torch.no_grad()
def errors_of(
    pair: PredictorPair, data: StandardSteps, rows: IntArray, absences: Tensor
) -> tuple[Tensor, Tensor]:
    """Squared errors at `rows`: (M, B, S) and (M, B)."""
    chunks = torch.split(torch.from_numpy(rows), CHUNK)
    parts = [pair.errors(data, chunk, absences) for chunk in chunks]
    next_errors, reward_errors = zip(*parts, strict=True)
    return torch.cat(next_errors, 1), torch.cat(reward_errors, 1)
