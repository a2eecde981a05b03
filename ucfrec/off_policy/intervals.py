"""Cluster bootstrap: intervals of ratios of sums over sessions, users resampled whole."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from ucfrec.arrays import BoolArray, Float64Array, IntArray

RESAMPLES = 2000
MOST_CLUSTERS = 10_000
"""Of more, random groups are drawn, all of about one size: the error stays, and time and memory do
not grow with the logs."""
FEWEST_USERS = 10
"""Users below which their spread says too little for a conclusion."""
_COUNTS_AT_ONCE = 2**22
_USABLE = 0.9
"""Share of resamples that must have a spread of their own."""


@dataclass(frozen=True)
class Interval:
    """What resampling says of one number."""

    low: float
    high: float
    error: float
    """Standard error, over clusters."""
    above_zero: float
    """Share of resamples in which the number is above 0."""


def cluster_intervals(
    above: Float64Array,
    below: Float64Array,
    cluster: IntArray | None,
    seed: int,
) -> list[Interval | None]:
    """Studentised 95% bootstrap intervals of the ratios Σ above / Σ below.

    Clusters are drawn with replacement, each with all its sessions (Cameron, Gelbach & Miller,
    Review of Economics and Statistics 2008), and every resample's deviation is divided by its own
    standard error (Efron & Tibshirani 1993, section 12.5): where a few heavy weights carry the sum,
    value and error rise and fall together, which percentiles of the value alone miss.

    Args:
        above: (S, K), one row per session, one column per estimate.
        below: (S, K).
        cluster: (S,) of each session, any integers; None where each session is its own.

    Returns:
        One per column; None where nothing spreads: one cluster, all clusters equal, or so few that
        differ that more than a tenth of the resamples have no spread.
    """
    resamples = resample(above, below, cluster, seed)
    usable = resamples.usable
    intervals: list[Interval | None] = []
    for k, (value, error) in enumerate(zip(resamples.value, resamples.error, strict=True)):
        rows = usable[:, k]
        if not resamples.spreads[k] or rows.mean() < _USABLE:
            intervals.append(None)
            continue
        shift, errors = resamples.shift[rows, k], resamples.errors[rows, k]
        low_t, high_t = np.quantile(shift / errors, [0.025, 0.975])
        low, high = float(value - high_t * error), float(value - low_t * error)
        intervals.append(Interval(low, high, float(error), float((value + shift > 0).mean())))
    return intervals


@dataclass(frozen=True)
class Resamples:
    """K ratios, and B resamples of them; the same clusters are drawn for all K."""

    value: Float64Array
    """(K,)."""
    error: Float64Array
    """(K,) standard errors over clusters."""
    shift: Float64Array
    """(B, K) of each resample: its ratio less `value`."""
    errors: Float64Array
    """(B, K) its own standard error."""
    spreads: BoolArray
    """(K,) whether clusters differ at all."""

    @property
    def usable(self) -> BoolArray:
        """(B, K) whether the resample has a spread of its own."""
        return np.asarray(np.isfinite(self.shift) & (self.errors > 1e-9 * self.error))


def resample(
    above: Float64Array, below: Float64Array, cluster: IntArray | None, seed: int
) -> Resamples:
    """Draw clusters with replacement, each with all its sessions.

    Args:
        above: (S, K), one row per session, one column per ratio Σ above / Σ below.
        below: (S, K).
        cluster: (S,) of each session, any integers; None where each session is its own.
    """
    names, clusters = _number_clusters(cluster, len(above))
    if clusters > MOST_CLUSTERS:
        shuffled = np.random.default_rng(seed).permutation(clusters)
        names, clusters = shuffled[names] % MOST_CLUSTERS, MOST_CLUSTERS
    above, below = (
        np.stack([np.bincount(names, column, clusters) for column in values.T], axis=1).astype(
            np.float64, copy=False
        )
        for values in (above, below)
    )
    value = above.sum(axis=0) / below.sum(axis=0)
    # Deviations from the estimate, in units that keep squares of large weights finite.
    scale = np.maximum(np.abs(above - value * below).max(axis=0), np.finfo(float).tiny)
    size = np.abs(below).max(axis=0)
    e, b = (above - value * below) / scale, below / size
    unit = scale / size
    correction = np.sqrt(clusters / max(clusters - 1, 1))
    error = correction * np.sqrt((e**2).sum(axis=0)) / b.sum(axis=0)
    moments = np.stack([e, b, e * e, e * b, b * b])
    shift, errors = _draw_resamples(moments, correction, seed)
    spreads = (error > 1e-12) & (clusters > 1)
    return Resamples(value, error * unit, shift * unit, errors * unit, spreads)


def cluster_mean(
    values: Float64Array, cluster: IntArray | None, weights: Float64Array | None = None
) -> tuple[float, float]:
    """Mean of values (S,) and its standard error over clusters.

    Args:
        cluster: (S,); None where each value is its own.
        weights: (S,) how often each value counts; None for once each.
    """
    names, clusters = _number_clusters(cluster, len(values))
    above = np.bincount(names, values if weights is None else values * weights, clusters)
    below = np.bincount(names, weights, clusters)
    mean = above.sum() / below.sum()
    spread = np.square(above - mean * below).sum()
    return float(mean), float(np.sqrt(clusters / max(clusters - 1, 1) * spread) / below.sum())


def _number_clusters(cluster: IntArray | None, sessions: int) -> tuple[IntArray, int]:
    """(S,) clusters numbered from 0, and how many there are."""
    if cluster is None:
        return np.arange(sessions), sessions
    names = np.unique(cluster, return_inverse=True)[1]
    return names, int(names.max()) + 1


def _draw_resamples(
    moments: Float64Array, correction: float, seed: int
) -> tuple[Float64Array, Float64Array]:
    """Deviation from the estimate (B, K) in each resample, and the resample's standard error.

    Args:
        moments: (5, C, K) of clusters: e, b, e², e b and b², where the estimate is Σe / Σb = 0.
    """
    _, clusters, columns = moments.shape
    flat = np.moveaxis(moments, 1, 0).reshape(clusters, -1)
    counts, at_once = _draw_counts(clusters, seed), max(1, _COUNTS_AT_ONCE // clusters)
    shifts, errors = [], []
    for begin in range(0, RESAMPLES, at_once):
        # How often each cluster is drawn stands for the resampled rows.
        times = counts[begin : begin + at_once].astype(np.float64)
        e, b, ee, eb, bb = (times @ flat).reshape(-1, 5, columns).swapaxes(0, 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            shift = np.where(b > 0, e / b, np.nan)
            spread = np.maximum(ee - 2 * shift * eb + shift**2 * bb, 0.0)
            errors.append(correction * np.sqrt(spread) / b)
        shifts.append(shift)
    return np.concatenate(shifts), np.concatenate(errors)


@lru_cache(maxsize=1)
def _draw_counts(clusters: int, seed: int) -> npt.NDArray[np.uint16]:
    """(B, C) how often each resample has each cluster, at most 40 MB.

    Kept for the next call: an estimate, its verdict and a selection draw the same clusters.
    """
    generator = np.random.default_rng(seed)
    counts = np.empty((RESAMPLES, clusters), dtype=np.uint16)
    at_once = max(1, min(RESAMPLES, _COUNTS_AT_ONCE // clusters))
    for begin in range(0, RESAMPLES, at_once):
        draws = min(at_once, RESAMPLES - begin)
        picked = generator.integers(clusters, size=(draws, clusters))
        picked += np.arange(draws)[:, None] * clusters
        times = np.bincount(picked.ravel(), minlength=draws * clusters)
        counts[begin : begin + draws] = times.reshape(draws, clusters)
    counts.setflags(write=False)
    return counts
