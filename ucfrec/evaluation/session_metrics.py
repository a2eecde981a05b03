"""Metrics of simulated episodes (R_cum, two versions of R_avg, length) and bootstrap intervals."""

from dataclasses import dataclass

import numpy as np

from ucfrec.acting.rollout import Episodes
from ucfrec.arrays import Float64Array

_RESAMPLES = 2000


@dataclass(frozen=True)
class SessionMetrics:
    """Metrics of a set of episodes; rewards and returns in reward units."""

    R_cum: float
    """Mean episode return (called R_tra in some papers)."""
    R_cum_low: float
    """Lower end of the 95% percentile bootstrap interval of R_cum, over episodes."""
    R_cum_high: float
    """Upper end of the same interval."""
    R_avg_pooled: float
    """Sum of all rewards divided by the number of all steps (called R_each in some papers)."""
    R_avg_episode: float
    """Mean over episodes of the episode's mean reward per step."""
    length: float
    """Mean number of steps per episode."""
    episodes: int
    """Number of episodes."""


def session_metrics(played: Episodes, seed: int) -> SessionMetrics:
    """Metrics of the simulated episodes; `seed` seeds the bootstrap."""
    low, high = bootstrap_interval(played.returns, seed)
    return SessionMetrics(
        R_cum=float(played.returns.mean()),
        R_cum_low=low,
        R_cum_high=high,
        R_avg_pooled=float(played.returns.sum() / played.lengths.sum()),
        R_avg_episode=float((played.returns / played.lengths).mean()),
        length=float(played.lengths.mean()),
        episodes=len(played.returns),
    )


def bootstrap_interval(values: Float64Array, seed: int) -> tuple[float, float]:
    """95% percentile bootstrap interval (low, high) of the mean of `values` (N,)."""
    means = resampled_ratios(values[:, None], np.ones((len(values), 1)), seed)
    low, high = np.nanquantile(means, [0.025, 0.975])
    return float(low), float(high)


def resampled_ratios(above: Float64Array, below: Float64Array, seed: int) -> Float64Array:
    """Ratios Σ above / Σ below (2000, C) of rows (N, C) drawn with replacement.

    Ratios whose denominator is 0 are NaN.
    """
    generator = np.random.default_rng(seed)
    # Multinomial counts of the rows replace copies of them, which limits memory to O(N).
    share, both = np.full(len(above), 1 / len(above)), np.hstack([above, below])
    sums = np.array([generator.multinomial(len(both), share) @ both for _ in range(_RESAMPLES)])
    numerators, denominators = np.hsplit(sums, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(denominators > 0, numerators / denominators, np.nan)
