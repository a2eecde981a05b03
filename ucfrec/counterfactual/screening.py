"""Which observation columns measure the reward, although they are logged with the state.

A dimension d_t that records the reward (r_t, or r_{t+1}) predicts it as a cause would, but what the
rest explains of it, the action above all, it explains through the reward. So

1. the rest (other dimensions, action, next action) helps to predict d_t;
2. the reward alone predicts d_t at least as well;
3. given the reward, the rest hardly helps any more.

A cause fails one of these. If the logging policy did not see it, the action explains none of it
(1); if the policy did, the action explains it with or without the reward (3). A dimension of a
process that goes on, such as a position, is explained by other dimensions (3).

Features of items and users have the same values wherever a policy acts, so they are not screened.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.processes import progress, random_state_kept
from ucfrec.user_model.reward_report import draw_numbers

CLIP: Final = 10.0
"""Standardised values beyond this many standard deviations are clipped."""
MAX_TRANSITIONS: Final = 100_000
"""Largest number of transitions used; of more, that many are drawn."""
TREES: Final = 150
"""Largest number of boosted trees that predict a dimension."""
_LEAVES, _LEARNING_RATE, _PATIENCE = 15, 0.1, 8
"""Of the trees; fewer grow where rows kept apart are predicted no better."""
_MIN_EXPLAINED, _LEVEL = 0.003, 0.001
"""Least share of a dimension's variance that the rest and the reward must each explain, and the
level of the test that they do."""
_MOST_ADDED = 0.25
"""Largest share of what the rest explains that it may add to the reward."""
_HELD_OUT_EVERY = 5
_ANSWERS = {True: "yes", False: "no", None: "–"}


@dataclass(frozen=True)
class DimensionReport:
    """Whether one dimension has an effect; in control, what it adds to others and the action."""

    dimension: int
    effect: float | None = None
    """Share it explains of what the others leave unexplained of the next dimensions it helps most
    (partial R², their mean), the reward given; None where it is not tested, as in logs of items."""
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
    reward_r2: float | None
    """Held-out R² of the reward with all dimensions known; None in logs of items."""
    transitions: int

    @property
    def flagged(self) -> tuple[int, ...]:
        """Dimensions without effect."""
        return tuple(d.dimension for d in self.dimensions if not d.causes)

    def describe(self) -> str:
        """The verdicts as a table."""
        r2 = "" if self.reward_r2 is None else f", reward R² {self.reward_r2:.4f}"
        lines = [f"{self.transitions:,} transitions{r2}", ""]
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


@random_state_kept()
def screen(train: EpisodeStore, seed: int) -> ScreeningReport:
    """Test every logged observation dimension of a log of items: one that measures the reward
    counts as without effect.

    Raises:
        InputError: no observations are logged, there are too few episodes to hold some out, or
            actions are vectors.
    """
    if not train.observation_size:
        raise InputError(
            f"{train.path} has no logged observations to screen; its states are made of items"
        )
    if not train.has_items:
        raise InputError(
            f"the actions of {train.path} are vectors; screen it with ucfrec-control, which tests "
            "what each dimension predicts"
        )
    measures = find_measurements(train, MAX_TRANSITIONS, seed).items()
    reports = (DimensionReport(d, measures_reward=yes, causes=not yes) for d, yes in measures)
    episodes, _ = steps_with_successor(train, MAX_TRANSITIONS, seed)
    return ScreeningReport(tuple(reports), None, len(episodes))


def find_measurements(
    train: EpisodeStore,
    most: int,
    seed: int,
    dimensions: Sequence[int] | None = None,
) -> dict[int, bool]:
    """Whether observation dimensions of training episodes measure the reward, by their errors on
    held-out episodes; None stands for all dimensions. At most `most` transitions are used.

    Raises:
        InputError: there are too few episodes with two steps or more to hold some out.
    """
    tested = range(train.observation_size) if dimensions is None else dimensions
    if not tested:
        return {}
    data, leaks = _Steps(train, most, seed), set[int]()
    others = [d for d in range(data.columns.shape[1]) if d not in tested]
    count = len(tested) + len(others)
    with progress(count, "screening, what measures the reward", "dimensions") as bar:
        for dimension in (*tested, *others):
            if dimension in others and not leaks:
                break
            if _measures(data, dimension, (), seed):
                leaks.add(dimension)
            bar.update()
    # A measurement explains a cause too, through the reward: the others are excluded from the rest.
    return {
        d: d in leaks
        and (
            len(leaks) == 1
            or _measures(
                data,
                d,
                leaks - {d},
                seed,
            )
        )
        for d in tested
    }


class _Steps:
    """Standardised steps that have a successor: N logged observations (N, O), the `rest` of the
    state, the action and the next one (N, R), and rewards of the step and the next one (N, 2)."""

    def __init__(
        self,
        view: EpisodeStore,
        most: int,
        seed: int,
    ) -> None:
        self.episodes, steps = steps_with_successor(view, most, seed)
        now = view.transitions(self.episodes, steps)
        then = view.transitions(self.episodes, steps + 1)
        item_part, observed = now.states.tensor_split([-view.observation_size], dim=1)
        self.columns = standardise(observed).numpy()
        self.rest = standardise(torch.cat([item_part, now.actions, then.actions], dim=1)).numpy()
        self.rewards = standardise(torch.stack([now.rewards, then.rewards], dim=1)).numpy()
        self.held_out = held_out_steps(view, self.episodes)


def _measures(
    data: _Steps,
    dimension: int,
    without: Collection[int],
    seed: int,
) -> bool:
    """Whether a dimension measures the reward; the columns `without` are excluded from the rest."""
    from sklearn.ensemble import HistGradientBoostingRegressor  # takes a second to import

    values, held_out = data.columns[:, dimension], data.held_out
    alone = np.square(values[held_out] - values[~held_out].mean(dtype=np.float64))
    variance = max(float(alone.mean()), 1e-12)

    def explain(columns: Float32Array) -> Float64Array:
        """Share (B,) of the variance that columns explain of held-out steps."""
        model = HistGradientBoostingRegressor(
            learning_rate=_LEARNING_RATE,
            max_iter=TREES,
            max_leaf_nodes=_LEAVES,
            early_stopping=True,
            n_iter_no_change=_PATIENCE,
            random_state=seed,
        )
        model.fit(columns[~held_out], values[~held_out])
        errors = np.square(values[held_out] - model.predict(columns[held_out]))
        return np.asarray((alone - errors) / variance)

    def is_explained(shares: Float64Array) -> bool:
        p_value = compute_p_value(torch.from_numpy(shares), data.episodes[held_out])
        return bool(shares.mean() >= _MIN_EXPLAINED) and p_value < _LEVEL

    # The cheapest first: most dimensions fail one of these.
    by_reward = explain(data.rewards)
    if not is_explained(by_reward):
        return False
    inputs = np.column_stack(
        [
            np.delete(data.columns, [dimension, *without], axis=1),
            data.rest,
        ]
    )
    by_rest = explain(inputs)
    if not is_explained(by_rest) or by_reward.mean() < by_rest.mean():
        return False
    by_both = explain(np.column_stack([inputs, data.rewards]))
    return bool(by_both.mean() - by_reward.mean() <= _MOST_ADDED * by_rest.mean())


def steps_with_successor(view: EpisodeStore, most: int, seed: int) -> tuple[IntArray, IntArray]:
    """Episodes and steps (N,), not the last of their session; of more than `most`, so many."""
    episodes, steps = view.all_steps()
    inner = np.flatnonzero(steps < view.lengths[episodes] - 1)
    inner = inner[draw_numbers(len(inner), most, seed)]
    return episodes[inner], steps[inner]


def held_out_steps(train: EpisodeStore, episodes: IntArray) -> BoolArray:
    """Which steps (N,) are held out, given their episodes (N,): those of every fifth.

    Raises:
        InputError: there are too few episodes to hold some out.
    """
    held_out = np.asarray(episodes % _HELD_OUT_EVERY == _HELD_OUT_EVERY // 2)
    if len(np.unique(episodes[held_out])) < 3:
        raise InputError(
            f"{train.path} has {train.n_episodes} training episodes, too few of them with two "
            f"steps or more; screening needs at least {3 * _HELD_OUT_EVERY}"
        )
    return held_out


def standardise(values: Tensor) -> Tensor:
    """Columns with mean 0 and standard deviation 1, clipped; constant ones are 0."""
    std, mean = torch.std_mean(values, dim=0)
    return ((values - mean) / torch.where(std > 1e-6, std, 1.0)).clamp(-CLIP, CLIP)


def compute_p_value(differences: Tensor, episodes: IntArray) -> float:
    """Of a mean of at most 0, one-sided, of differences (B,) of steps whose whole episodes (B,) are
    independent."""
    from scipy import stats  # takes long to import

    _, cluster = np.unique(episodes, return_inverse=True)
    counts = np.bincount(cluster)
    values = differences.double().numpy()
    residual = np.bincount(cluster, values) - counts * values.mean()
    # Cluster-robust standard error of the mean.
    error = np.sqrt((residual**2).sum() * len(counts) / (len(counts) - 1)) / len(values)
    return float(stats.t.sf(values.mean() / max(error, 1e-300), len(counts) - 1))
