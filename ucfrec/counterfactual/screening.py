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

Features of items and users are not screened: a policy reads them from its run's own tables, so
that they have the same values in the logs and wherever it acts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec.counterfactual.measured_reward import (
    MeasurementConfig,
    clustered_p_value,
    measured_reward,
)
from ucfrec.counterfactual.missing_dimensions import (
    CHUNK,
    PredictorPair,
    StandardSteps,
    absences_of,
    errors_of,
    own_pairs,
    shared_pair,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import IntArray
from ucfrec.errors import InputError
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.settings import BatchSize, Count, LearningRate, Share, Width, settings_table

_HELPED = 3
_SAID = {True: "yes", False: "no", None: "–"}


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
    (partial R², their mean), the reward given; None where it is not tested, as in logs of items."""
    helps: tuple[int, ...]
    """Those dimensions, most helped first, chosen on fitted episodes."""
    p_value: float | None
    """Of no help there, one-sided, over held-out episodes."""
    reward_effect: float | None
    """Share it explains of the reward's variance."""
    reward_p_value: float | None
    measures_reward: bool | None
    """Whether it tells of the reward after the fact; None where that does not matter."""
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
    data = StandardSteps.of(train, config.max_transitions, seed)

    def measured(dimensions: Sequence[int]) -> dict[int, bool]:
        found = measured_reward(train, config.measurement, config.max_transitions, seed, dimensions)
        return dict(zip(dimensions, found, strict=True))

    if train.has_items:
        verdicts = measured(range(train.observation_size))
        reports = [_untested(dimension, measures) for dimension, measures in verdicts.items()]
        return ScreeningReport(tuple(reports), None, len(data.episodes))
    torch.manual_seed(seed)
    shared = shared_pair(
        data, config.hidden, config.shared_steps, config.batch_size, config.learning_rate
    )
    with random_state_kept():  # whether only some are tested changes nothing else
        r2 = _Effects.of(shared, data, (), config, seed).r2
    tested: Sequence[int] = range(data.states.shape[1])
    measures: dict[int, bool] = {}
    if r2 < config.min_reward_r2:
        # Only what measures the reward can be without effect; the effects of the rest are left out.
        measures = measured(tested)
        tested = [dimension for dimension, yes in measures.items() if yes]
    effects = _Effects.of(shared, data, tested, config, seed)
    undecided = [each.dimension for each in effects.found if each.undecided]
    measures |= measured([dimension for dimension in undecided if dimension not in measures])
    found = {each.dimension: each.report(measures.get(each.dimension)) for each in effects.found}
    size = data.states.shape[1]
    reports = [found.get(dimension) or _untested(dimension, False) for dimension in range(size)]
    return ScreeningReport(tuple(reports), effects.r2, len(data.episodes))


def _untested(dimension: int, measures: bool) -> DimensionReport:
    """A verdict by whether a dimension measures the reward alone."""
    return DimensionReport(dimension, None, (), None, None, None, measures, not measures)


def _rows(data: StandardSteps) -> IntArray:
    """The held-out steps."""
    return np.flatnonzero(data.held_out)


def _reward_variance(data: StandardSteps) -> float:
    return max(float(data.rewards[torch.from_numpy(_rows(data))].var()), 1e-12)


def _r2(errors: Tensor, data: StandardSteps) -> float:
    """Held-out R² of the reward, of squared errors (B,)."""
    return 1 - float(errors.mean()) / _reward_variance(data)


@dataclass(frozen=True)
class _Effect:
    """What a dimension adds to the predictions."""

    dimension: int
    effect: float
    helps: tuple[int, ...]
    p_value: float
    reward_effect: float
    reward_p_value: float
    helps_next: bool
    helps_reward: bool
    """True too where the reward can hardly be predicted."""

    @property
    def undecided(self) -> bool:
        """Whether it matters that the dimension may measure the reward."""
        return self.helps_reward and not self.helps_next

    def report(self, measures: bool | None) -> DimensionReport:
        """The verdict; `measures` is None if it does not matter."""
        causes = self.helps_next or (self.helps_reward and not measures)
        return DimensionReport(
            self.dimension, self.effect, self.helps, self.p_value, self.reward_effect,
            self.reward_p_value, measures, causes,
        )  # fmt: skip


@dataclass(frozen=True)
class _Effects:
    """The effects of some dimensions, and the R² of the reward with none missing."""

    found: Sequence[_Effect]
    r2: float

    @classmethod
    def of(
        cls,
        shared: PredictorPair,
        data: StandardSteps,
        dimensions: Sequence[int],
        config: ScreeningConfig,
        seed: int,
    ) -> "_Effects":
        absences = absences_of(data, dimensions)
        rate = config.learning_rate / 3
        pair = own_pairs(shared, data, absences, config.own_steps, config.batch_size, rate)
        seen = np.flatnonzero(~data.held_out)
        sample = np.random.default_rng(seed).choice(seen, min(len(seen), 4 * CHUNK), replace=False)
        fitted = errors_of(pair, data, np.sort(sample), absences)[0].mean(1)
        next_errors, reward_errors = errors_of(pair, data, _rows(data), absences)
        r2, size = _r2(reward_errors[-1], data), data.states.shape[1]
        gain = 1 - fitted[-1] / fitted[:-1].clamp(min=1e-12)  # (M, S)
        gain[absences[:-1, 0] > 0] = -torch.inf
        most_helped = gain.topk(min(_HELPED, size - 1)).indices
        found = []
        for row, dimension in enumerate(dimensions):
            effect = _effect_on_next(next_errors[[row, -1]][:, :, most_helped[row]], data, config)
            more = reward_errors[row] - reward_errors[-1]
            of_reward = float(more.mean()) / _reward_variance(data)
            p_value = clustered_p_value(more, data.episodes[_rows(data)])
            found.append(
                _Effect(
                    dimension=dimension,
                    effect=effect[0],
                    helps=tuple(most_helped[row].tolist()),
                    p_value=effect[1],
                    reward_effect=of_reward,
                    reward_p_value=p_value,
                    helps_next=effect[0] >= config.min_effect and effect[1] < config.level,
                    helps_reward=r2 < config.min_reward_r2
                    or (of_reward >= config.min_reward_effect and p_value < config.level),
                )
            )
        return cls(found, r2)


def _effect_on_next(
    pair: Tensor, data: StandardSteps, config: ScreeningConfig
) -> tuple[float, float]:
    """Share explained of what is left unexplained, and its p-value.

    Args:
        pair: (2, B, H) squared errors of helped dimensions, without and with a dimension.
        data: all steps.
        config: of the tests.
    """
    capped = pair.minimum(pair.flatten(0, 1).quantile(1 - config.capped, dim=0))
    saved = (capped[0] - capped[1]) / capped[0].mean(0).clamp(min=1e-12)
    return float(saved.mean()), clustered_p_value(saved.mean(1), data.episodes[_rows(data)])


def describe_screening(report: ScreeningReport) -> str:
    """The verdicts as a table."""
    r2 = "" if report.reward_r2 is None else f", reward R² {report.reward_r2:.4f}"
    lines = [f"{report.transitions:,} transitions{r2}", ""]
    lines.append("dimension  next state        p     reward        p  measures reward  causes")
    lines += [
        f"{d.dimension:>9}  {_number(d.effect, '.4f'):>10}  {_number(d.p_value, '.1g'):>7}  "
        f"{_number(d.reward_effect, '.5f'):>9}  {_number(d.reward_p_value, '.1g'):>7}  "
        f"{_SAID[d.measures_reward]:>15}  {'yes' if d.causes else 'NOTHING'}"
        for d in report.dimensions
    ]
    flagged = ", ".join(map(str, report.flagged)) or "none"
    return "\n".join([*lines, "", f"dimensions without effect: {flagged}"])


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else f"{value:{form}}"
