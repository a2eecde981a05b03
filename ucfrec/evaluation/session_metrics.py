"""Metrics of simulated episodes (R_cum, two versions of R_avg, length) and bootstrap intervals."""

import numpy as np

from ucfrec.acting.rollout import Episodes
from ucfrec.arrays import Float64Array

_RESAMPLES = 2000


def session_metrics(played: Episodes) -> dict[str, float]:
    """Metrics of simulated episodes; rewards and returns in reward units.

    Returns:
        `R_cum`: mean episode return (called R_tra in some papers). `R_avg_pooled`: sum of all
        rewards divided by the number of all steps (called R_each in some papers). `R_avg_episode`:
        mean over episodes of the episode's mean reward per step. `length`: mean number of steps of
        an episode.
    """
    returns, lengths = played.returns, played.lengths
    return {
        "R_cum": float(returns.mean()),
        "R_avg_pooled": float(returns.sum() / lengths.sum()),
        "R_avg_episode": float((returns / lengths).mean()),
        "length": float(lengths.mean()),
    }


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
