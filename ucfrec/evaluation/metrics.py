"""What episodes earned: R_cum, R_avg in both readings, length, with bootstrap intervals."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ucfrec.acting.rollout import Episodes

_RESAMPLES = 2000


@dataclass(frozen=True)
class SessionMetrics:
    """Means over episodes."""

    R_cum: float
    """Mean episode return (R_tra elsewhere)."""
    R_cum_low: float
    """Lower end of the 95% percentile bootstrap interval of R_cum, over episodes."""
    R_cum_high: float
    R_avg_pooled: float
    """All reward over all steps (R_each elsewhere)."""
    R_avg_episode: float
    """Mean over episodes of the episode's own mean reward a step."""
    length: float
    """Mean steps an episode."""
    episodes: int


def session_metrics(played: Episodes, seed: int) -> SessionMetrics:
    """Summarise episodes; `seed` draws the bootstrap's resamples."""
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


def bootstrap_interval(
    values: npt.NDArray[np.float64], seed: int, level: float = 0.95
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean of `values` (N,)."""
    ((low, high),) = ratio_intervals(values[:, None], np.ones((len(values), 1)), seed, level)
    return float(low), float(high)


def ratio_intervals(
    above: npt.NDArray[np.float64], below: npt.NDArray[np.float64], seed: int, level: float = 0.95
) -> npt.NDArray[np.float64]:
    """Percentile bootstrap intervals (C, 2) of the ratios Σ above / Σ below of rows (N, C).

    Resamples in which nothing stands below are left out.
    """
    ratios = resampled_ratios(above, below, seed)
    return np.asarray(np.nanquantile(ratios, [(1 - level) / 2, (1 + level) / 2], axis=0).T)


def resampled_ratios(
    above: npt.NDArray[np.float64], below: npt.NDArray[np.float64], seed: int
) -> npt.NDArray[np.float64]:
    """Σ above / Σ below of rows (N, C) drawn with replacement, (2000, C); NaN where nothing stands
    below."""
    generator = np.random.default_rng(seed)
    # Multinomial counts stand for resampled rows: memory stays at N, whatever the resamples.
    share, both = np.full(len(above), 1 / len(above)), np.hstack([above, below])
    sums = np.array([generator.multinomial(len(both), share) @ both for _ in range(_RESAMPLES)])
    numerators, denominators = np.hsplit(sums, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(denominators > 0, numerators / denominators, np.nan)
