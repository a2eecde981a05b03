"""Which state dimensions cause nothing (assumption A3, minimality).

A dimension has an effect if it helps to predict the reward or the rest of the next state, given the
other dimensions and the action, on held-out episodes. The next state is predicted with the reward
as a further input: what measures the reward, as distractors do, then adds nothing. Of the reward it
must explain a minimum share; a measurement explains no more than the predictor's error.

Indicators of a category follow from one another, and help together alone: so all that would be
flagged but measurements of the reward is tested once more, together and without these.

Where the reward cannot be predicted well without what measures it, no help is no evidence. There a
dimension is flagged only if it is such a measurement (`ucfrec.counterfactual.screening`) and does
not help to predict the next state.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.counterfactual.screening import (
    CLIP,
    MAX_TRANSITIONS,
    DimensionReport,
    ScreeningReport,
    compute_p_value,
    find_measurements,
    held_out_steps,
    standardise,
    steps_with_successor,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.processes import progress, random_state_kept
from ucfrec.runs.start import training_views

_CHUNK = 1024
_HELPED = 3


@dataclass(frozen=True)
class ScreeningConfig:
    """Predictors, and how much help counts."""

    hidden: int = 192
    """Width of the two hidden layers of a predictor."""
    shared_steps: int = 3000
    """Updates of one predictor that serves every missing dimension."""
    own_steps: int = 1000
    """Updates of its copy for each missing dimension, which else seems to help if it is nearly a
    function of others."""
    batch_size: int = 256
    """Transitions of an update."""
    learning_rate: float = 3e-3
    """Highest step size of the updates; a third of it for the copies."""
    max_transitions: int = MAX_TRANSITIONS
    """Largest number of transitions used."""
    min_effect: float = 0.01
    """Least share of a next dimension's unexplained variance that counts as help."""
    capped: float = 0.005
    """Share of the largest errors of a next dimension that count as the largest below: where a
    body falls, one step in a thousand may make up half of their sum."""
    min_reward_effect: float = 0.01
    """Least share of the reward's variance that counts as help."""
    level: float = 0.01
    """Level of the tests, over held-out episodes."""
    min_reward_r2: float = 0.9
    """Least R² of the reward at which no help is evidence."""


def screen_store(store: EpisodeStore, seed: int) -> ScreeningReport:
    """Screen the training episodes of a control store, by the default settings."""
    return screen_states(training_views(store)[0], ScreeningConfig(), seed)


@random_state_kept()
def screen_states(train: EpisodeStore, config: ScreeningConfig, seed: int) -> ScreeningReport:
    """Test the effect of every dimension of the states of training episodes.

    Raises:
        InputError: there are too few episodes to hold some out.
    """
    torch.manual_seed(seed)
    data = _Data(train, config, seed)
    shared = _fit_shared(data)
    measures: dict[int, bool] = {}

    def measured(dimensions: Sequence[int]) -> list[int]:
        """Those of `dimensions` that measure the reward."""
        new = [dimension for dimension in dimensions if dimension not in measures]
        measures.update(find_measurements(train, config.max_transitions, seed, new))
        return [dimension for dimension in dimensions if measures[dimension]]

    tested: Sequence[int] = range(data.size)
    with random_state_kept():  # what is found out first changes nothing else
        r2 = _fit_own(shared, data, [()]).r2(0)
        if r2 >= config.min_reward_r2:
            # A measurement predicts the reward well, whatever else does.
            leaks = measured(_find_helpful(shared, data))
            r2 = _fit_own(shared, data, [leaks]).r2(0) if leaks else r2
    if hard := r2 < config.min_reward_r2:
        # Only what measures the reward can be without effect; the effects of the rest are excluded.
        tested = measured(tested)
    errors, none = _fit_own(shared, data, [*((d,) for d in tested), ()]), len(tested)
    reports, undecided = {}, []
    for row, dimension in enumerate(tested):
        report, helps_next, helps_reward = errors.compare(row, none, dimension)
        if (hard or helps_reward) and not helps_next:
            undecided.append(dimension)
        reports[dimension] = replace(report, causes=hard or helps_next or helps_reward)
    measured(undecided)
    for dimension, report in reports.items():
        yes = measures.get(dimension)
        causes = report.causes and not (dimension in undecided and yes)
        reports[dimension] = replace(report, measures_reward=yes, causes=causes)
    flagged = [dimension for dimension, report in reports.items() if not report.causes]
    if len(flagged) > 1:
        leaks = measured(flagged)
        varies = (data.states != data.states[0]).any(0)
        untied = [d for d in flagged if d not in leaks and varies[d]]
        together = False
        if untied:
            # Beside a measurement of the reward its causes are no help.
            both = _fit_own(shared, data, [(*leaks, *untied), leaks])
            together = any(both.compare(0, 1, -1)[1:])
        for d in leaks:
            reports[d] = replace(reports[d], measures_reward=True)
        for d in untied:
            reports[d] = replace(reports[d], measures_reward=False, causes=together)
    complete = [
        reports.get(d) or DimensionReport(d, measures_reward=False) for d in range(data.size)
    ]
    return ScreeningReport(tuple(complete), errors.r2(none), len(data.episodes))


class _Data:
    """Standardised steps that have a successor: N states, actions, rewards (N, 1), and changes of
    the state until the next step."""

    def __init__(self, view: EpisodeStore, config: ScreeningConfig, seed: int) -> None:
        self.episodes, steps = steps_with_successor(view, config.max_transitions, seed)
        transitions = view.transitions(self.episodes, steps)
        mean, std = view.state_statistics
        scale = torch.where(std > 1e-6, std, 1.0)
        states = (transitions.states - mean) / scale
        self.states, self.size = states.clamp(-CLIP, CLIP), states.shape[1]
        self.actions = standardise(transitions.actions)
        self.rewards = standardise(transitions.rewards.unsqueeze(1))
        self.changes = standardise((transitions.next_states - mean) / scale - states)
        self.moving = self.changes.abs().amax(0) > 0
        held_out = held_out_steps(view, self.episodes)
        self.seen, self.held_out = np.flatnonzero(~held_out), np.flatnonzero(held_out)
        variance = self.rewards[torch.from_numpy(self.held_out)].var()
        self.reward_variance = max(float(variance), 1e-12)
        self.config, self.seed = config, seed

    def absences(self, missing: Sequence[Collection[int]]) -> Tensor:
        """(M, 1, S): row m misses the dimensions `missing[m]`."""
        absences = torch.zeros(len(missing), 1, self.size)
        for row, dimensions in enumerate(missing):
            absences[row, 0, list(dimensions)] = 1.0
        return absences


class _Perceptrons(nn.Module):
    """M perceptrons of one shape, side by side."""

    def __init__(self, sizes: Sequence[int], count: int = 1) -> None:
        super().__init__()
        pairs = list(pairwise(sizes))
        self.weights = nn.ParameterList(torch.randn(count, i, o) / i**0.5 for i, o in pairs)
        self.biases = nn.ParameterList(torch.zeros(count, 1, o) for _, o in pairs)

    def forward(self, inputs: Tensor) -> Tensor:
        """(M, B, in) to (M, B, out)."""
        hidden = inputs
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, nn.functional.silu(hidden) if layer else hidden, weight)
        return hidden


class _Predictors(nn.Module):
    """M predictors of the next state, the reward given, and of the reward, dimensions missing."""

    def __init__(self, data: _Data, count: int = 1) -> None:
        super().__init__()
        width, inputs = data.config.hidden, 2 * data.size + data.actions.shape[1]
        self.next_state = _Perceptrons((inputs + 1, width, width, data.size), count)
        self.reward = _Perceptrons((inputs, width, width, 1), count)

    def errors(self, data: _Data, rows: Tensor, missing: Tensor) -> tuple[Tensor, Tensor]:
        """Squared errors (M, B, S) and (M, B); `missing` (M, 1 or B, S) is 1 where missing."""
        missing = missing.expand(-1, len(rows), -1)
        actions = data.actions[rows].expand(len(missing), -1, -1)
        rewards = data.rewards[rows].expand(len(missing), -1, -1)
        inputs = torch.cat([data.states[rows] * (1 - missing), missing, actions], 2)
        next_errors = self.next_state(torch.cat([inputs, rewards], 2)) - data.changes[rows]
        return next_errors.square(), (self.reward(inputs) - rewards).square().squeeze(2)

    @torch.no_grad()
    def all_errors(self, data: _Data, rows: np.ndarray, absences: Tensor) -> tuple[Tensor, Tensor]:
        """`errors` of many rows, some at a time."""
        chunks = torch.split(torch.from_numpy(rows), _CHUNK)
        parts = [self.errors(data, chunk, absences) for chunk in chunks]
        next_errors, reward_errors = zip(*parts, strict=True)
        return torch.cat(next_errors, 1), torch.cat(reward_errors, 1)

    def fit(
        self, data: _Data, draw: Callable[[], Tensor], steps: int, rate: float, job: str
    ) -> None:
        """Update `steps` times; `draw` gives what is missing."""
        rows = torch.from_numpy(data.seen)
        optimizer = torch.optim.Adam(self.parameters(), lr=rate)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps)
        with progress(steps, f"screening, {job}", "steps") as bar:
            for _ in range(steps):
                absent = draw()
                batch = rows[torch.randint(len(rows), (data.config.batch_size,))]
                next_errors, reward_errors = self.errors(data, batch, absent)
                # A missing dimension's own future is not part of the rest.
                loss = (next_errors * (1 - absent)).mean((1, 2)).sum() + reward_errors.mean(1).sum()
                optimizer.zero_grad(set_to_none=True)
                loss.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                schedule.step()
                bar.update()


def _fit_shared(data: _Data) -> _Predictors:
    """A pair of predictors that serves every missing dimension."""
    config, size = data.config, data.size
    predictors = _Predictors(data)
    absences = data.absences([*((dimension,) for dimension in range(size)), ()])[:, 0]

    def draw() -> Tensor:
        # A third of the rows miss nothing, so that the complete predictor is not the worst trained.
        rows = torch.randint(3 * size // 2 + 1, (config.batch_size,)).clamp(max=size)
        return absences[rows].unsqueeze(0)

    predictors.fit(data, draw, config.shared_steps, config.learning_rate, "common")
    return predictors


def _find_helpful(shared: _Predictors, data: _Data) -> list[int]:
    """Dimensions without which the shared predictor knows less of the reward."""
    whole, *errors = (
        float(shared.all_errors(data, data.held_out, data.absences([missing]))[1].mean())
        for missing in [(), *((dimension,) for dimension in range(data.size))]
    )
    most = whole + data.config.min_reward_effect * data.reward_variance
    return [dimension for dimension, error in enumerate(errors) if error >= most]


class _Errors(NamedTuple):
    """Squared errors of predictors that each miss some dimensions."""

    data: _Data
    absences: Tensor
    """(M, 1, S)."""
    fitted: Tensor
    """(M, S) means over fitted steps."""
    next_state: Tensor
    """(M, B, S) at held-out steps."""
    reward: Tensor
    """(M, B) at held-out steps."""

    def r2(self, row: int) -> float:
        """Held-out R² of the reward."""
        return 1 - float(self.reward[row].mean()) / self.data.reward_variance

    def compare(
        self, without: int, having: int, dimension: int
    ) -> tuple[DimensionReport, bool, bool]:
        """What row `without` leaves unexplained, of the next dimensions that `having` helps most
        and of the reward; and whether either counts."""
        data, config = self.data, self.data.config
        gain = 1 - self.fitted[having] / self.fitted[without].clamp(min=1e-12)
        gain[(self.absences[without, 0] > 0) | ~data.moving] = -torch.inf
        helped = gain.topk(min(_HELPED, int((gain > -torch.inf).sum()))).indices
        effect, p_value, episodes = 0.0, 1.0, data.episodes[data.held_out]
        if len(helped):
            pair = self.next_state[[without, having]][:, :, helped]
            capped = pair.minimum(pair.flatten(0, 1).quantile(1 - config.capped, dim=0))
            saved = (capped[0] - capped[1]) / capped[0].mean(0).clamp(min=1e-12)
            effect, p_value = float(saved.mean()), compute_p_value(saved.mean(1), episodes)
        more = self.reward[without] - self.reward[having]
        of_reward = float(more.mean()) / data.reward_variance
        reward_p_value = compute_p_value(more, episodes)
        report = DimensionReport(
            dimension, effect, tuple(helped.tolist()), p_value, of_reward, reward_p_value
        )
        helps_next = effect >= config.min_effect and p_value < config.level
        helps_reward = of_reward >= config.min_reward_effect and reward_p_value < config.level
        return report, helps_next, helps_reward


def _fit_own(shared: _Predictors, data: _Data, missing: Sequence[Collection[int]]) -> _Errors:
    """Fit a copy of the shared pair for each of `missing` further, and measure its errors."""
    config, absences = data.config, data.absences(missing)
    pair = _Predictors(data, len(missing))
    with torch.no_grad():
        for copy, original in zip(pair.parameters(), shared.parameters(), strict=True):
            copy.copy_(original.expand_as(copy))
    rate, job = config.learning_rate / 3, f"{len(missing)} cases"
    pair.fit(data, lambda: absences, config.own_steps, rate, job)
    rng, count = np.random.default_rng(data.seed), min(len(data.seen), 4 * _CHUNK)
    sample = np.sort(rng.choice(data.seen, count, replace=False))
    fitted = pair.all_errors(data, sample, absences)[0].mean(1)
    next_state, reward = pair.all_errors(data, data.held_out, absences)
    return _Errors(data, absences, fitted, next_state, reward)
