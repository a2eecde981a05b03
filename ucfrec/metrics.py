"""What episodes earned: R_cum, R_avg in both readings, length, with bootstrap intervals."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ucfrec.rollout import Episodes

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
    generator = np.random.default_rng(seed)
    # Multinomial counts stand for resampled rows: memory stays at N, whatever the resamples.
    share = np.full(len(values), 1 / len(values))
    means = [
        generator.multinomial(len(values), share) @ values / len(values) for _ in range(_RESAMPLES)
    ]
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
