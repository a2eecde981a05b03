"""Which state dimensions cause nothing (assumption A3, minimality).

A dimension has an effect if it helps to predict the reward or the rest of the next state, given the
other dimensions and the action, on held-out episodes. The next state is predicted with the reward
as a further input: what measures the reward, as distractors do, then adds nothing. Of the reward it
must explain a minimum share; a measurement explains no more than the predictor's error.

Indicators of a category follow from one another, and help together alone: so all that would be
flagged but measurements of the reward is tested once more, together and without these.

Where the reward cannot be predicted well without what measures it, no help is no evidence. There a
dimension is flagged only if it is such a measurement and does not help to predict the next state.

A dimension d_t that measures the reward (r_t, or r_{t+1}) predicts it as a cause would, but what
the rest explains of it, the action above all, it explains through the reward. So

1. the rest (other dimensions, action, next action) helps to predict d_t;
2. the reward alone predicts d_t at least as well;
3. given the reward, the rest hardly helps any more.

A cause fails one of these. If the logging policy did not see it, the action explains none of it
(1); if the policy did, the action explains it with or without the reward (3). A dimension of a
process that goes on, such as a position, is explained by other dimensions (3).
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from pydantic import TypeAdapter
from torch import Tensor, nn

from ucfrec.arrays import Float32Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.processes import progress, random_state_kept
from ucfrec.runs.record import TrainingRecord
from ucfrec.runs.start import training_views
from ucfrec.user_model.reward_report import draw_numbers

SCREENING, TREATMENT = "screening", "treatment"
"""Extra entries of a run's record: the report, and what was done about it, "drop" or "copies"."""
_CHUNK = 1024
_HELPED = 3
_CLIP = 10.0
"""Standardised values beyond this many standard deviations are clipped."""
_MIN_EXPLAINED, _LEVEL = 0.003, 0.001
"""Least share of a dimension's variance that the rest and the reward must each explain, and the
level of the test that they do."""
_MOST_ADDED = 0.25
"""Largest share of what the rest explains that it may add to the reward."""
_HELD_OUT_EVERY = 5
_ANSWERS = {True: "yes", False: "no", None: "–"}


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
    max_transitions: int = 100_000
    """Largest number of transitions used; of more, that many are drawn."""
    trees: int = 150
    """Largest number of boosted trees that predict a dimension from the reward or the rest; fewer
    grow where rows kept apart are predicted no better."""
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


@dataclass(frozen=True)
class DimensionReport:
    """Whether one dimension has an effect, and what it adds to the others and the action."""

    dimension: int
    effect: float | None = None
    """Share it explains of what the others leave unexplained of the next dimensions it helps most
    (partial R², their mean), the reward given; None where it is not tested."""
    helps: tuple[int, ...] = ()
    """Those dimensions, most helped first, chosen on fitted episodes."""
    p_value: float | None = None
    """Of no help there, one-sided, over held-out episodes."""
    reward_effect: float | None = None
    """Share it explains of the reward's variance."""
    reward_p_value: float | None = None
    measures_reward: bool | None = None
    """Whether it records the reward after the fact; None where that does not matter."""
    causes: bool = True
    """Whether it counts as having an effect, be it for want of evidence, or with others that are no
    help one by one."""


@dataclass(frozen=True)
class ScreeningReport:
    """The verdict on every dimension."""

    dimensions: tuple[DimensionReport, ...]
    reward_r2: float
    """Held-out R² of the reward with all dimensions known."""
    transitions: int

    @property
    def flagged(self) -> tuple[int, ...]:
        """Dimensions without effect."""
        return tuple(d.dimension for d in self.dimensions if not d.causes)

    def describe(self) -> str:
        """The verdicts as a table."""
        lines = [f"{self.transitions:,} transitions, reward R² {self.reward_r2:.4f}", ""]
        lines.append("dimension  next state        p     reward        p  measures reward  causes")
        for d in self.dimensions:
            numbers = (
                (d.effect, ".4f", 10),
                (d.p_value, ".1g", 7),
                (d.reward_effect, ".5f", 9),
                (d.reward_p_value, ".1g", 7),
            )
            line = f"{d.dimension:>9}"
            for value, form, width in numbers:
                line += f"  {'–' if value is None else format(value, form):>{width}}"
            measures, causes = _ANSWERS[d.measures_reward], "yes" if d.causes else "NOTHING"
            lines.append(f"{line}  {measures:>15}  {causes}")
        flagged = ", ".join(map(str, self.flagged)) or "none"
        return "\n".join([*lines, "", f"dimensions without effect: {flagged}"])


def read_screening(record: TrainingRecord) -> ScreeningReport | None:
    """What the screening before a training found; None if there was none."""
    report = record.extra.get(SCREENING)
    return None if report is None else TypeAdapter(ScreeningReport).validate_python(report)


def screen_store(store: EpisodeStore, seed: int) -> ScreeningReport:
    """Screen the training episodes of a control store, by the default settings."""
    return screen_states(training_views(store)[0], ScreeningConfig(), seed)


@random_state_kept()
def screen_states(train: EpisodeStore, config: ScreeningConfig, seed: int) -> ScreeningReport:
    """Test the effect of every dimension of the states of training episodes. InputError if there
    are too few episodes to hold some out."""
    torch.manual_seed(seed)
    data = _Data(train, config, seed)
    shared = _fit_shared(data)
    measures: dict[int, bool] = {}

    def select_measurements(dimensions: Sequence[int]) -> list[int]:
        """Those of `dimensions` that measure the reward."""
        if new := [dimension for dimension in dimensions if dimension not in measures]:
            measures.update(_find_measurements(data, new))
        return [dimension for dimension in dimensions if measures[dimension]]

    tested: Sequence[int] = range(data.size)
    with random_state_kept():  # what is found out first changes nothing else
        r2 = _fit_own(shared, data, [()]).r2(0)
        if r2 >= config.min_reward_r2:
            # A measurement predicts the reward well, whatever else does.
            leaks = select_measurements(_find_helpful(shared, data))
            r2 = _fit_own(shared, data, [leaks]).r2(0) if leaks else r2
    if hard := r2 < config.min_reward_r2:
        # Only what measures the reward can be without effect; the effects of the rest are excluded.
        tested = select_measurements(tested)
    errors, none = _fit_own(shared, data, [*((d,) for d in tested), ()]), len(tested)
    reports, undecided = {}, []
    for row, dimension in enumerate(tested):
        report, helps_next, helps_reward = errors.compare(row, none, dimension)
        if (hard or helps_reward) and not helps_next:
            undecided.append(dimension)
        reports[dimension] = replace(report, causes=hard or helps_next or helps_reward)
    select_measurements(undecided)
    for dimension, report in reports.items():
        yes = measures.get(dimension)
        causes = report.causes and not (dimension in undecided and yes)
        reports[dimension] = replace(report, measures_reward=yes, causes=causes)
    flagged = [dimension for dimension, report in reports.items() if not report.causes]
    if len(flagged) > 1:
        leaks = select_measurements(flagged)
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
        episodes, steps = view.all_steps()
        inner = np.flatnonzero(steps < view.lengths[episodes] - 1)
        inner = inner[draw_numbers(len(inner), config.max_transitions, seed)]
        self.episodes, steps = episodes[inner], steps[inner]
        now = view.transitions(self.episodes, steps)
        then = view.transitions(self.episodes, steps + 1)
        mean, std = view.state_statistics
        scale = torch.where(std > 0, std, 1.0)
        states = (now.states - mean) / scale
        self.states, self.size = states.clamp(-_CLIP, _CLIP), states.shape[1]
        self.actions = _standardise(now.actions)
        self.rewards = _standardise(now.rewards.unsqueeze(1))
        self.changes = _standardise((now.next_states - mean) / scale - states)
        self.moving = self.changes.abs().amax(0) > 0
        # What measurements of the reward are told by.
        self.columns = _standardise(now.states).numpy()
        self.both_actions = _standardise(torch.cat([now.actions, then.actions], dim=1)).numpy()
        self.both_rewards = _standardise(torch.stack([now.rewards, then.rewards], dim=1)).numpy()
        held_out = self.episodes % _HELD_OUT_EVERY == _HELD_OUT_EVERY // 2
        self.seen, self.held_out = np.flatnonzero(~held_out), np.flatnonzero(held_out)
        if len(np.unique(self.episodes[self.held_out])) < 3:
            raise InputError(
                f"{view.path} has {view.n_episodes} training episodes, too few of them with two "
                f"steps or more; screening needs at least {3 * _HELD_OUT_EVERY}"
            )
        variance = self.rewards[torch.from_numpy(self.held_out)].var()
        self.reward_variance = max(float(variance), 1e-12)
        self.config, self.seed = config, seed

    def absences(self, missing: Sequence[Collection[int]]) -> Tensor:
        """(M, 1, S): row m misses the dimensions `missing[m]`."""
        absences = torch.zeros(len(missing), 1, self.size)
        for row, dimensions in enumerate(missing):
            absences[row, 0, list(dimensions)] = 1.0
        return absences


def _find_measurements(data: _Data, tested: Sequence[int]) -> dict[int, bool]:
    """Whether dimensions measure the reward, by their errors on held-out episodes."""
    leaks, untested = set[int](), [d for d in range(data.size) if d not in tested]
    with progress(data.size, "screening, what measures the reward", "dimensions") as bar:
        for dimension in (*tested, *untested):
            if (dimension in tested or leaks) and _measures(data, dimension, ()):
                leaks.add(dimension)
            bar.update()
    # A measurement explains a cause too, through the reward: the others are excluded from the rest.
    return {d: d in leaks and (len(leaks) == 1 or _measures(data, d, leaks - {d})) for d in tested}


def _measures(data: _Data, dimension: int, without: Collection[int]) -> bool:
    """Whether a dimension measures the reward; the columns `without` are excluded from the rest."""
    from sklearn.ensemble import HistGradientBoostingRegressor  # takes a second to import

    values, seen, held_out = data.columns[:, dimension], data.seen, data.held_out
    alone = np.square(values[held_out] - values[seen].mean(dtype=np.float64))
    variance = max(float(alone.mean()), 1e-12)

    def explain(columns: Float32Array) -> Float64Array:
        """Share (B,) of the variance that columns explain of held-out steps."""
        model = HistGradientBoostingRegressor(
            max_iter=data.config.trees,
            max_leaf_nodes=15,
            early_stopping=True,
            n_iter_no_change=8,
            random_state=data.seed,
        )
        model.fit(columns[seen], values[seen])
        errors = np.square(values[held_out] - model.predict(columns[held_out]))
        return np.asarray((alone - errors) / variance)

    def is_explained(shares: Float64Array) -> bool:
        p_value = _compute_p_value([torch.from_numpy(shares)], data.episodes[held_out])
        return bool(shares.mean() >= _MIN_EXPLAINED) and p_value < _LEVEL

    # The cheapest first: most dimensions fail one of these.
    by_reward = explain(data.both_rewards)
    if not is_explained(by_reward):
        return False
    dimensions = np.delete(data.columns, [dimension, *without], axis=1)
    inputs = np.column_stack([dimensions, data.both_actions])
    by_rest = explain(inputs)
    if not is_explained(by_rest) or by_reward.mean() < by_rest.mean():
        return False
    by_both = explain(np.column_stack([inputs, data.both_rewards]))
    return bool(by_both.mean() - by_reward.mean() <= _MOST_ADDED * by_rest.mean())


def _standardise(values: Tensor) -> Tensor:
    """Columns with mean 0 and standard deviation 1, clipped; constant ones are 0."""
    std, mean = torch.std_mean(values, dim=0)
    constant = values.amax(0) == values.amin(0)
    return ((values - mean) / std.masked_fill(constant, torch.inf)).clamp(-_CLIP, _CLIP)


def _compute_shares(pair: Tensor) -> Tensor:
    """How much lower the second errors of a pair (2, …) are, from −1 to 1: all steps count alike,
    where few may make up most of a difference."""
    return (pair[0] - pair[1]) / pair.sum(0).clamp(min=1e-12)


def _compute_p_value(measures: Sequence[Tensor], episodes: IntArray) -> float:
    """Of a mean of at most 0, one-sided, of steps whose whole episodes (B,) are independent: the
    lowest one of several measures (B,) of them."""
    from scipy import stats  # takes long to import

    _, cluster = np.unique(episodes, return_inverse=True)
    counts, ratios = np.bincount(cluster), []
    for values in (measure.double().numpy() for measure in measures):
        residual = np.bincount(cluster, values) - counts * values.mean()
        # Cluster-robust standard error of the mean.
        error = np.sqrt((residual**2).sum() * len(counts) / (len(counts) - 1)) / len(values)
        ratios.append(values.mean() / max(error, 1e-300))
    return float(stats.t.sf(max(ratios), len(counts) - 1))


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
            steps = (saved.mean(1), _compute_shares(pair).mean(1))
            effect, p_value = float(saved.mean()), _compute_p_value(steps, episodes)
        both = self.reward[[without, having]]
        of_reward = float((both[0] - both[1]).mean()) / data.reward_variance
        reward_p_value = _compute_p_value((both[0] - both[1], _compute_shares(both)), episodes)
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
