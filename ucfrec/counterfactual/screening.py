"""Which state dimensions cause nothing (assumption A3, minimality).

A dimension of observed states has an effect if it helps to predict the reward or the rest of the
next state, given the other dimensions and the action. Both predictions are evaluated on held-out
episodes. The next state is predicted with the reward as a further input: a dimension that measures
the reward, as distractors do, then adds nothing even if the predictors are imperfect. For the
reward this is not possible. There the improvement must be a minimum share of the reward's whole
variance; a measurement of the reward explains no more than the predictor's error. The largest
errors of the next state are capped, so that a few falls do not decide the test.

Where the reward can hardly be predicted, as clicks, no help is no evidence, and a measurement of
the reward helps most. There a dimension counts as without effect only if it is such a measurement
(`ucfrec.counterfactual.measured_reward`) and does not help to predict the next state. In logs of
items the logged observation is screened, and by that test alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.counterfactual.measured_reward import (
    CLIP,
    MeasurementConfig,
    clustered_p_value,
    held_out_of,
    measured_reward,
    standardised,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import IntArray
from ucfrec.errors import InputError
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.settings import BatchSize, Count, LearningRate, Share, Width, settings_table

_CHUNK = 1024
_HELPED = 3


@settings_table("screening")
class ScreeningConfig:
    """Predictors, and how much help counts."""

    hidden: Width = 192
    """Width of the two hidden layers of a predictor."""
    shared_steps: Count = 3000
    """Updates of one predictor that serves every missing dimension."""
    own_steps: Count = 1000
    """Updates of a copy of it for each missing dimension; without them a dimension that is nearly
    a function of others seems to help."""
    batch_size: BatchSize = 256
    """Transitions of an update."""
    learning_rate: LearningRate = 3e-3
    """Highest step size of the updates; a third of it for the copies."""
    max_transitions: Annotated[int, Field(ge=100, le=10**9)] = 100_000
    """Largest number of transitions used; of more, that many are drawn."""
    min_effect: Share = 0.01
    """Least share of a next dimension's unexplained variance that counts as help."""
    capped: Share = 0.005
    """Share of the largest squared errors of a next dimension that count as the largest below:
    where a body falls, one step in a thousand may make up half of their sum."""
    min_reward_effect: Share = 0.01
    """Least share of the reward's variance that counts as help."""
    level: Share = 0.01
    """Level of the tests, over held-out episodes."""
    min_reward_r2: Share = 0.5
    """Least R² of the reward at which it counts as evidence that a dimension does not help."""
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    """The test whether a dimension measures the reward."""


@dataclass(frozen=True)
class DimensionReport:
    """What one state dimension adds to the others and the action."""

    dimension: int
    effect: float | None
    """Share it explains of what the others leave unexplained of the next dimensions it helps most
    (partial R², their mean), the reward given; None in logs of items, where it is not tested."""
    helps: tuple[int, ...]
    """Those dimensions, most helped first, chosen on fitted episodes."""
    p_value: float | None
    """Of no help there, one-sided, over held-out episodes."""
    reward_effect: float | None
    """Share it explains of the reward's variance."""
    reward_p_value: float | None
    measures_reward: bool
    """Whether it tells of the reward after the fact."""
    causes: bool
    """Whether it counts as having an effect, be it for want of evidence."""


@dataclass(frozen=True)
class ScreeningReport:
    """The verdict on every dimension."""

    dimensions: tuple[DimensionReport, ...]
    reward_r2: float | None
    """Held-out R² of the reward with all dimensions known; None in logs of items."""
    transitions: int

    @property
    def flagged(self) -> tuple[int, ...]:
        """Dimensions without effect."""
        return tuple(d.dimension for d in self.dimensions if not d.causes)


@random_state_kept()
def screen(train: EpisodeStore, config: ScreeningConfig, seed: int) -> ScreeningReport:
    """Test the effect of every logged observation dimension.

    Args:
        train: a view of the training episodes.
        config: of the tests.
        seed: of the predictors.

    Raises:
        InputError: no observations are logged, or there are too few episodes to hold some out.
    """
    if not train.observation_size:
        raise InputError(
            f"{train.path} has no logged observations to screen; its states are made of items"
        )
    measures = measured_reward(train, config.measurement, config.max_transitions, seed)
    if train.has_items:
        verdicts = [
            DimensionReport(j, None, (), None, None, None, measured, not measured)
            for j, measured in enumerate(measures.flags)
        ]
        return ScreeningReport(tuple(verdicts), None, measures.transitions)
    data = _Transitions.of(train, config.max_transitions, seed)
    torch.manual_seed(seed)
    pair = _fitted(data, config)
    seen = np.flatnonzero(~data.held_out)
    sample = np.random.default_rng(seed).choice(seen, min(len(seen), 4 * _CHUNK), replace=False)
    fitted_errors, _ = _errors(pair, data, np.sort(sample))
    next_errors, reward_errors = _errors(pair, data, np.flatnonzero(data.held_out))
    return _report(data, fitted_errors, next_errors, reward_errors, measures.flags, config)


@dataclass(frozen=True)
class _Transitions:
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

    @classmethod
    def of(cls, view: EpisodeStore, most: int, seed: int) -> "_Transitions":
        episodes, steps = view.all_steps()
        inner = np.flatnonzero(steps < view.lengths[episodes] - 1)
        if len(inner) > most:
            inner = np.sort(np.random.default_rng(seed).choice(inner, most, replace=False))
        found = view.transitions(episodes[inner], steps[inner])
        mean, std = view.state_statistics
        states = (found.states - mean) / torch.where(std > 1e-6, std, 1.0)
        next_states = (found.next_states - mean) / torch.where(std > 1e-6, std, 1.0)
        return cls(
            states=states.clamp(-CLIP, CLIP),
            actions=standardised(found.actions),
            rewards=standardised(found.rewards.unsqueeze(1)),
            changes=standardised(next_states - states),
            episodes=episodes[inner],
            held_out=held_out_of(episodes[inner]),
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


class _Pair(nn.Module):
    """Predictors of the next state, the reward given, and of the reward, dimensions missing."""

    def __init__(self, next_state: _Predictors, reward: _Predictors) -> None:
        super().__init__()
        self.next_state, self.reward = next_state, reward

    def errors(self, data: _Transitions, rows: Tensor, missing: Tensor) -> tuple[Tensor, Tensor]:
        """Squared errors (M, B, S) and (M, B); `missing` (M, 1 or B, S) is 1 where missing."""
        missing = missing.expand(-1, len(rows), -1)

        def spread(values: Tensor) -> Tensor:
            return values[rows].expand(len(missing), -1, -1)

        inputs = torch.cat([data.states[rows] * (1 - missing), missing, spread(data.actions)], 2)
        with_reward = torch.cat([inputs, spread(data.rewards)], 2)
        next_errors = (self.next_state(with_reward) - data.changes[rows]).square()
        return next_errors, (self.reward(inputs) - data.rewards[rows]).square().squeeze(2)


def _absences(size: int) -> Tensor:
    """(S + 1, S): row j misses dimension j, the last row none."""
    return torch.cat([torch.eye(size), torch.zeros(1, size)])


def _fitted(data: _Transitions, config: ScreeningConfig) -> _Pair:
    """S + 1 pairs of predictors, one for each row of `_absences`."""
    size, width = data.states.shape[1], config.hidden
    inputs = 2 * size + data.actions.shape[1]
    pair = _Pair(
        _Predictors((inputs + 1, width, width, size)), _Predictors((inputs, width, width, 1))
    )
    absences = _absences(size)

    def some_missing() -> Tensor:
        # A third of the rows miss nothing, so that the complete predictor is not the worst trained.
        drawn = torch.randint(3 * size // 2 + 1, (config.batch_size,)).clamp(max=size)
        return absences[drawn].unsqueeze(0)

    _optimise(pair, data, some_missing, config.shared_steps, config.learning_rate, config)
    pair = _Pair(pair.next_state.repeated(size + 1), pair.reward.repeated(size + 1))
    one_missing = absences.unsqueeze(1)
    _optimise(pair, data, lambda: one_missing, config.own_steps, config.learning_rate / 3, config)
    return pair


def _optimise(
    pair: _Pair,
    data: _Transitions,
    missing: Callable[[], Tensor],
    steps: int,
    learning_rate: float,
    config: ScreeningConfig,
) -> None:
    rows = torch.from_numpy(np.flatnonzero(~data.held_out))
    optimizer = torch.optim.Adam(pair.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, steps)
    for _ in range(steps):
        absent = missing()
        batch = rows[torch.randint(len(rows), (config.batch_size,))]
        next_errors, reward_errors = pair.errors(data, batch, absent)
        # A missing dimension's own future is no part of the rest.
        loss = (next_errors * (1 - absent)).mean((1, 2)).sum() + reward_errors.mean(1).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()


@torch.no_grad()
def _errors(pair: _Pair, data: _Transitions, rows: IntArray) -> tuple[Tensor, Tensor]:
    """Squared errors at `rows`: (S + 1, B, S) and (S + 1, B)."""
    absent = _absences(data.states.shape[1]).unsqueeze(1)
    chunks = torch.split(torch.from_numpy(rows), _CHUNK)
    parts = [pair.errors(data, chunk, absent) for chunk in chunks]
    next_errors, reward_errors = zip(*parts, strict=True)
    return torch.cat(next_errors, 1), torch.cat(reward_errors, 1)


def _report(
    data: _Transitions,
    fitted_errors: Tensor,
    next_errors: Tensor,
    reward_errors: Tensor,
    measures: Sequence[bool],
    config: ScreeningConfig,
) -> ScreeningReport:
    size = data.states.shape[1]
    rows = np.flatnonzero(data.held_out)
    variance = float(data.rewards[torch.from_numpy(rows)].var())
    fitted = fitted_errors.mean(1)
    gain = 1 - fitted[-1] / fitted[:-1].clamp(min=1e-12)  # (S, S)
    most_helped = gain.fill_diagonal_(-torch.inf).topk(min(_HELPED, size - 1)).indices
    r2 = 1 - float(reward_errors[-1].mean()) / max(variance, 1e-12)
    found = []
    for j in range(size):
        pair = next_errors[[j, -1]][:, :, most_helped[j]]  # (2, B, helped)
        without, with_it = pair.minimum(pair.flatten(0, 1).quantile(1 - config.capped, dim=0))
        saved = (without - with_it) / without.mean(0).clamp(min=1e-12)
        effect, p_value = float(saved.mean()), clustered_p_value(saved.mean(1), data.episodes[rows])
        more = reward_errors[j] - reward_errors[-1]
        reward_effect = float(more.mean()) / max(variance, 1e-12)
        reward_p_value = clustered_p_value(more, data.episodes[rows])
        helps_next = effect >= config.min_effect and p_value < config.level
        helps_reward = (
            reward_effect >= config.min_reward_effect and reward_p_value < config.level
        ) or r2 < config.min_reward_r2
        found.append(
            DimensionReport(
                dimension=j,
                effect=effect,
                helps=tuple(most_helped[j].tolist()),
                p_value=p_value,
                reward_effect=reward_effect,
                reward_p_value=reward_p_value,
                measures_reward=measures[j],
                causes=helps_next or (helps_reward and not measures[j]),
            )
        )
    return ScreeningReport(tuple(found), r2, len(data.states))


def describe_screening(report: ScreeningReport) -> str:
    """The verdicts as a table."""
    r2 = "" if report.reward_r2 is None else f", reward R² {report.reward_r2:.4f}"
    lines = [f"{report.transitions:,} transitions{r2}", ""]
    lines.append("dimension  next state        p     reward        p  measures reward  causes")
    lines += [
        f"{d.dimension:>9}  {_number(d.effect, '.4f'):>10}  {_number(d.p_value, '.1g'):>7}  "
        f"{_number(d.reward_effect, '.5f'):>9}  {_number(d.reward_p_value, '.1g'):>7}  "
        f"{'yes' if d.measures_reward else 'no':>15}  {'yes' if d.causes else 'NOTHING'}"
        for d in report.dimensions
    ]
    flagged = ", ".join(map(str, report.flagged)) or "none"
    return "\n".join([*lines, "", f"dimensions without effect: {flagged}"])


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else f"{value:{form}}"
