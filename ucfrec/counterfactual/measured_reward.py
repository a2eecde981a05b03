"""Which observation dimensions measure the reward, although they are logged with the state.

A dimension d_t that records the reward (r_t, or r_{t+1}) is a leak: where it is fixed, nothing
changes. It predicts the reward as a cause would, but depends on nothing else: what the rest
explains of it, the action above all, it explains through the reward. So

1. the rest (other dimensions, action, next action) helps to predict d_t;
2. the reward alone predicts d_t at least as well;
3. given the reward, the rest hardly helps any more.

A cause fails one of these. If the logging policy did not see it, the action explains none of it
(1); if the policy did, the action explains it with or without the reward (3). A dimension of a
process that goes on, such as a position or a user's feature, is explained by other dimensions (3).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec.arrays import BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.progress import progress
from ucfrec.settings import Count, LearningRate, Share, settings_table

CLIP: Final = 10.0
"""Standardised values beyond this many standard deviations are clipped."""
_HELD_OUT_EVERY = 5
_PATIENCE = 8


@settings_table("measurement")
class MeasurementConfig:
    """Boosted trees that predict a dimension, and how much must be left for a cause."""

    trees: Count = 150
    """Largest number of trees; fewer where rows kept apart are predicted no better."""
    leaves: Annotated[int, Field(ge=2, le=1000)] = 15
    """Largest number of leaves of a tree."""
    learning_rate: LearningRate = 0.1
    """Share of each tree's prediction that is added."""
    min_told: Share = 0.003
    """Least share of a dimension's variance that the rest must explain without the reward."""
    most_left: Share = 0.25
    """Largest share of that which the rest may add to the reward."""
    level: Annotated[float, Field(gt=0, lt=1)] = 0.001
    """Level of the tests that the rest and the reward explain the dimension at all."""


def measured_reward(
    train: EpisodeStore,
    config: MeasurementConfig,
    most: int,
    seed: int,
    dimensions: Sequence[int] | None = None,
) -> tuple[bool, ...]:
    """Whether observation dimensions measure the reward, by their errors on held-out episodes.

    Args:
        train: a view of the training episodes, with observations.
        seed: of the transitions and of the rows kept apart.
        dimensions: to test; None for all.

    Returns:
        One verdict for each of `dimensions`.

    Raises:
        InputError: there are too few episodes with two steps or more to hold some out.
    """
    data = _Steps.of(train, most, seed)
    every = range(data.columns.shape[1])
    tested = every if dimensions is None else dimensions

    def verdicts(dimensions: Sequence[int]) -> dict[int, bool]:
        found = {}
        with progress(len(dimensions), "screening, what measures the reward", "dimensions") as bar:
            for dimension in dimensions:
                found[dimension] = _measures(data, dimension, (), config, seed)
                bar.update()
        return found

    first = verdicts(tested)
    if not any(first.values()):
        return tuple(first.values())
    first |= verdicts([dimension for dimension in every if dimension not in first])
    found = {dimension for dimension, measures in first.items() if measures}
    # A measurement explains a cause too, through the reward: the others are excluded from the rest.
    return tuple(
        d in found and (len(found) == 1 or _measures(data, d, found - {d}, config, seed))
        for d in tested
    )


@dataclass(frozen=True)
class _Steps:
    """Standardised steps that have a successor."""

    columns: Float32Array
    """(N, O) logged observations."""
    rest: Float32Array
    """(N, R) the rest of the state, the action and the next one."""
    rewards: Float32Array
    """(N, 2) of the step and of the next one."""
    episodes: IntArray
    held_out: BoolArray
    """(N,)."""

    @classmethod
    def of(cls, view: EpisodeStore, most: int, seed: int) -> "_Steps":
        episodes, steps = steps_with_successor(view, most, seed)
        now = view.transitions(episodes, steps)
        then = view.transitions(episodes, steps + 1)
        size = view.observation_size
        others = now.states[:, : now.states.shape[1] - size]
        return cls(
            columns=standardised(now.states[:, -size:]).numpy(),
            rest=standardised(torch.cat([others, now.actions, then.actions], dim=1)).numpy(),
            rewards=standardised(torch.stack([now.rewards, then.rewards], dim=1)).numpy(),
            episodes=episodes,
            held_out=held_out_of(view, episodes),
        )


def _measures(
    data: _Steps, dimension: int, without: Collection[int], config: MeasurementConfig, seed: int
) -> bool:
    """Whether a dimension measures the reward; the columns `without` are excluded from the rest."""
    values, held_out = data.columns[:, dimension], data.held_out
    alone = np.square(values[held_out] - values[~held_out].mean(dtype=np.float64))
    variance = max(float(alone.mean()), 1e-12)

    def saved(inputs: Float32Array) -> Float64Array:
        """Share (B,) of the variance that the inputs explain of held-out steps."""
        predicted = _predicted(inputs, values, held_out, config, seed)
        return np.asarray((alone - np.square(values[held_out] - predicted)) / variance)

    def explains(shares: Float64Array) -> bool:
        p_value = clustered_p_value(torch.from_numpy(shares), data.episodes[held_out])
        return bool(shares.mean() >= config.min_told) and p_value < config.level

    # The cheapest first: most dimensions fail one of these.
    of_reward = saved(data.rewards)
    if not explains(of_reward):
        return False
    others = np.delete(data.columns, [dimension, *without], axis=1)
    rest = np.column_stack([others, data.rest])
    of_rest = saved(rest)
    if not explains(of_rest) or of_reward.mean() < of_rest.mean():
        return False
    both = saved(np.column_stack([rest, data.rewards]))
    return bool(both.mean() - of_reward.mean() <= config.most_left * of_rest.mean())


def _predicted(
    inputs: Float32Array,
    values: Float32Array,
    held_out: BoolArray,
    config: MeasurementConfig,
    seed: int,
) -> Float64Array:
    """`values` (N,) of the held-out rows, predicted by what was fitted to the others."""
    from sklearn.ensemble import HistGradientBoostingRegressor  # takes a second to import

    model = HistGradientBoostingRegressor(
        learning_rate=config.learning_rate,
        max_iter=config.trees,
        max_leaf_nodes=config.leaves,
        early_stopping=True,
        n_iter_no_change=_PATIENCE,
        random_state=seed,
    )
    model.fit(inputs[~held_out], values[~held_out])
    return np.asarray(model.predict(inputs[held_out]))


def steps_with_successor(view: EpisodeStore, most: int, seed: int) -> tuple[IntArray, IntArray]:
    """Episodes and steps (N,), not the last of their session; of more than `most`, so many."""
    episodes, steps = view.all_steps()
    inner = np.flatnonzero(steps < view.lengths[episodes] - 1)
    if len(inner) > most:
        inner = np.sort(np.random.default_rng(seed).choice(inner, most, replace=False))
    return episodes[inner], steps[inner]


def held_out_of(train: EpisodeStore, episodes: IntArray) -> BoolArray:
    """Which steps are held out: those of every fifth episode.

    Args:
        train: a view of the training episodes.
        episodes: (N,) of which episode each step is.

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


def standardised(values: Tensor) -> Tensor:
    """Columns with mean 0 and standard deviation 1, clipped; constant ones are 0."""
    std, mean = torch.std_mean(values, dim=0)
    return ((values - mean) / torch.where(std > 1e-6, std, 1.0)).clamp(-CLIP, CLIP)


def clustered_p_value(differences: Tensor, episodes: IntArray) -> float:
    """Of a mean of at most 0, one-sided, where whole episodes (not steps) are independent.

    Args:
        differences: (B,).
        episodes: (B,) of which episode each is.
    """
    from scipy import stats  # takes long to import

    _, cluster = np.unique(episodes, return_inverse=True)
    counts = np.bincount(cluster)
    values = differences.double().numpy()
    residual = np.bincount(cluster, values) - counts * values.mean()
    # Cluster-robust standard error of the mean.
    error = np.sqrt((residual**2).sum() * len(counts) / (len(counts) - 1)) / len(values)
    return float(stats.t.sf(values.mean() / max(error, 1e-300), len(counts) - 1))
