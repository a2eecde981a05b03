"""Which state dimensions cause nothing (assumption A3, minimality).

A dimension of observed states has an effect if it helps to predict the reward or the rest of the
next state, given the other dimensions and the action. Both predictions are evaluated on held-out
episodes. The next state is predicted with the reward as a further input: a dimension that measures
the reward, as distractors do, then adds nothing even if the predictors are imperfect. For the
reward this is not possible. There the improvement must be a minimum share of the reward's whole
variance; a measurement of the reward explains no more than the predictor's error. The largest
errors of the next state are capped, so that a few falls do not decide the test.

What helps neither one by one may help together, as the indicators of a category do, which follow
from one another. So all that would be flagged but measurements of the reward is tested once more,
together and without these, and kept if it helps.

Where the reward cannot be predicted well without what measures it, as clicks, no help is no
evidence, and a measurement of the reward helps most. There a dimension counts as without effect
only if it is such a measurement (`ucfrec.counterfactual.measured_reward`) and does not help to
predict the next state. In logs of items the logged observation is screened, and by that test alone.

Features of items and users are not screened: a policy reads them from its run's own tables, so
that they have the same values in the logs and wherever it acts.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec.arrays import IntArray
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
from ucfrec.errors import InputError
from ucfrec.processes import random_state_kept
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
    min_reward_r2: Share = 0.9
    """Least R² of the reward at which it counts as evidence that a dimension does not help: many
    weak causes fit into a larger share that nothing explains."""
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
    """Whether it records the reward after the fact; None where that does not matter."""
    causes: bool
    """Whether it counts as having an effect, be it for want of evidence, or with others that are no
    help one by one."""


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

    Raises:
        InputError: no observations are logged, or there are too few episodes to hold some out.
    """
    if not train.observation_size:
        raise InputError(
            f"{train.path} has no logged observations to screen; its states are made of items"
        )
    data = StandardSteps.of(train, config.max_transitions, seed)

    def measured(dimensions: Sequence[int]) -> dict[int, bool]:
        if not dimensions:
            return {}
        verdicts = measured_reward(
            train, config.measurement, config.max_transitions, seed, dimensions
        )
        return dict(zip(dimensions, verdicts, strict=True))

    if train.has_items:
        verdicts = measured(range(train.observation_size))
        reports = [_untested(dimension, measures) for dimension, measures in verdicts.items()]
        return ScreeningReport(tuple(reports), None, len(data.episodes))
    torch.manual_seed(seed)
    shared = shared_pair(
        data, config.hidden, config.shared_steps, config.batch_size, config.learning_rate
    )
    tested: Sequence[int] = range(data.states.shape[1])
    with random_state_kept():  # what is found out first changes nothing else
        r2 = _Errors.of(shared, data, [()], config, seed).r2(0)
        measures: dict[int, bool] = {}
        if r2 >= config.min_reward_r2:
            # A measurement predicts the reward well, whatever else does.
            measures = measured(_helpful(shared, data, config))
            leaks = [dimension for dimension, yes in measures.items() if yes]
            r2 = _Errors.of(shared, data, [leaks], config, seed).r2(0) if leaks else r2
    if r2 < config.min_reward_r2:
        # Only what measures the reward can be without effect; the effects of the rest are excluded.
        measures |= measured([dimension for dimension in tested if dimension not in measures])
        tested = [dimension for dimension in tested if measures[dimension]]
    effects, r2 = _effects(shared, data, tested, config, seed, r2)
    undecided = [effect.dimension for effect in effects if effect.undecided]
    measures |= measured([dimension for dimension in undecided if dimension not in measures])
    reports_by_dimension = {
        effect.dimension: effect.report(measures.get(effect.dimension)) for effect in effects
    }
    flagged = [dimension for dimension, report in reports_by_dimension.items() if not report.causes]
    if len(flagged) > 1:
        measures |= measured([dimension for dimension in flagged if dimension not in measures])
        leaks = [dimension for dimension in flagged if measures[dimension]]
        constant = (data.states == data.states[0]).all(0)
        untied = [d for d in flagged if not measures[d] and not constant[d]]
        together = _help_together(untied, leaks, shared, data, config, seed)
        reports_by_dimension |= {
            d: replace(reports_by_dimension[d], measures_reward=True) for d in leaks
        }
        reports_by_dimension |= {
            d: replace(reports_by_dimension[d], measures_reward=False, causes=together)
            for d in untied
        }
    size = data.states.shape[1]
    reports = [
        reports_by_dimension.get(dimension) or _untested(dimension, False)
        for dimension in range(size)
    ]
    return ScreeningReport(tuple(reports), r2, len(data.episodes))


def _helpful(shared: PredictorPair, data: StandardSteps, config: ScreeningConfig) -> list[int]:
    """Dimensions without which the shared predictor knows less of the reward."""

    def error(*missing: int) -> float:
        return float(errors_of(shared, data, _rows(data), absences_of(data, [missing]))[1].mean())

    most = error() + config.min_reward_effect * _reward_variance(data)
    return [dimension for dimension in range(data.states.shape[1]) if error(dimension) >= most]


def _help_together(
    dimensions: Sequence[int],
    leaks: Sequence[int],
    shared: PredictorPair,
    data: StandardSteps,
    config: ScreeningConfig,
    seed: int,
) -> bool:
    """Whether dimensions that are no help one by one are some together, `leaks` unknown.

    Columns that follow from one another, as the indicators of a category, are no help each; and
    beside a measurement of the reward its causes are none.
    """
    if not dimensions:
        return False
    errors = _Errors.of(shared, data, [(*leaks, *dimensions), leaks], config, seed)
    of_next, of_reward = errors.effect(0, 1, config), errors.effect_on_reward(0, 1)
    helps_reward = of_reward.counts(config.min_reward_effect, config.level)
    return of_next.counts(config.min_effect, config.level) or helps_reward


def _untested(dimension: int, measures: bool) -> DimensionReport:
    """A verdict by whether a dimension measures the reward alone."""
    return DimensionReport(dimension, None, (), None, None, None, measures, not measures)


def _rows(data: StandardSteps) -> IntArray:
    """The held-out steps."""
    return np.flatnonzero(data.held_out)


def _reward_variance(data: StandardSteps) -> float:
    return max(float(data.rewards[torch.from_numpy(_rows(data))].var()), 1e-12)


@dataclass(frozen=True)
class _Help:
    """A share that is explained, and the p-value of none."""

    share: float
    p_value: float
    helps: tuple[int, ...] = ()
    """Next dimensions, most helped first."""

    def counts(self, least: float, level: float) -> bool:
        return self.share >= least and self.p_value < level


@dataclass(frozen=True)
class _Errors:
    """Squared errors of predictors that each miss some dimensions."""

    data: StandardSteps
    absences: Tensor
    """(M, 1, S)."""
    fitted: Tensor
    """(M, S) means over fitted steps."""
    next_state: Tensor
    """(M, B, S) at held-out steps."""
    reward: Tensor
    """(M, B) at held-out steps."""

    @classmethod
    def of(
        cls,
        shared: PredictorPair,
        data: StandardSteps,
        missing: Sequence[Collection[int]],
        config: ScreeningConfig,
        seed: int,
    ) -> "_Errors":
        absences, rate = absences_of(data, missing), config.learning_rate / 3
        pair = own_pairs(shared, data, absences, config.own_steps, config.batch_size, rate)
        seen = np.flatnonzero(~data.held_out)
        sample = np.random.default_rng(seed).choice(seen, min(len(seen), 4 * CHUNK), replace=False)
        fitted = errors_of(pair, data, np.sort(sample), absences)[0].mean(1)
        return cls(data, absences, fitted, *errors_of(pair, data, _rows(data), absences))

    def r2(self, row: int) -> float:
        """Held-out R² of the reward."""
        return 1 - float(self.reward[row].mean()) / _reward_variance(self.data)

    def effect(self, without: int, having: int, config: ScreeningConfig) -> _Help:
        """What row `without` leaves unexplained of the next dimensions that `having` helps most."""
        gain = 1 - self.fitted[having] / self.fitted[without].clamp(min=1e-12)
        gain[(self.absences[without, 0] > 0) | ~self.data.moving] = -torch.inf
        count = min(_HELPED, int((gain > -torch.inf).sum()))
        if not count:
            return _Help(0.0, 1.0)
        helped = gain.topk(count).indices
        pair = self.next_state[[without, having]][:, :, helped]
        return _Help(*_effect_on_next(pair, self.data, config), tuple(helped.tolist()))

    def effect_on_reward(self, without: int, having: int) -> _Help:
        more = self.reward[without] - self.reward[having]
        share = float(more.mean()) / _reward_variance(self.data)
        return _Help(share, clustered_p_value(more, self.data.episodes[_rows(self.data)]))


@dataclass(frozen=True)
class _Effect:
    """What a dimension adds to the predictions."""

    dimension: int
    of_next: _Help
    of_reward: _Help
    helps_next: bool
    helps_reward: bool
    """True too where the reward cannot be predicted well."""

    @property
    def undecided(self) -> bool:
        """Whether it matters that the dimension may measure the reward."""
        return self.helps_reward and not self.helps_next

    def report(self, measures: bool | None) -> DimensionReport:
        """The verdict; `measures` is None if it does not matter."""
        return DimensionReport(
            dimension=self.dimension,
            effect=self.of_next.share,
            helps=self.of_next.helps,
            p_value=self.of_next.p_value,
            reward_effect=self.of_reward.share,
            reward_p_value=self.of_reward.p_value,
            measures_reward=measures,
            causes=self.helps_next or (self.helps_reward and not measures),
        )


def _effects(
    shared: PredictorPair,
    data: StandardSteps,
    dimensions: Sequence[int],
    config: ScreeningConfig,
    seed: int,
    r2: float,
) -> tuple[list[_Effect], float]:
    """The effects of some dimensions, and the R² of the reward with none missing.

    Args:
        r2: R² of the reward without what measures it.
    """
    missing = [*((dimension,) for dimension in dimensions), ()]
    errors, hard = _Errors.of(shared, data, missing, config, seed), r2 < config.min_reward_r2
    effects, none = [], len(dimensions)
    for row, dimension in enumerate(dimensions):
        of_next, of_reward = errors.effect(row, none, config), errors.effect_on_reward(row, none)
        helps_next = of_next.counts(config.min_effect, config.level)
        helps_reward = hard or of_reward.counts(config.min_reward_effect, config.level)
        effects.append(_Effect(dimension, of_next, of_reward, helps_next, helps_reward))
    return effects, errors.r2(none)


def _effect_on_next(
    pair: Tensor, data: StandardSteps, config: ScreeningConfig
) -> tuple[float, float]:
    """Share explained of what is left unexplained, and its p-value.

    Args:
        pair: (2, B, H) squared errors of helped dimensions, without and with a dimension.
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
