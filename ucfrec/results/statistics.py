"""Statistics of samples: mean and spread over seeds, bootstrap, effective number, group AUC."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ucfrec.arrays import Array, BoolArray, Float64Array

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")
_RESAMPLES = 2000


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation of a sample."""

    mean: float
    """NaN without values."""
    sd: float
    """Standard deviation with n − 1 in the denominator; NaN for fewer than two values."""
    count: int
    """Number n of values."""

    @property
    def standard_error(self) -> float:
        """Standard error of the mean, sd / √n; NaN for fewer than two values."""
        return float(self.sd / np.sqrt(self.count))


def summary(values: Iterable[float]) -> Summary:
    """Mean, standard deviation and number of `values`."""
    sample = np.asarray(list(values), dtype=np.float64)
    mean = float(sample.mean()) if len(sample) else float("nan")
    sd = float(sample.std(ddof=1)) if len(sample) > 1 else float("nan")
    return Summary(mean, sd, len(sample))


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, Sequence[Item]]:
    """Group `items` by `key`; groups and their items stay in order of appearance."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return dict(groups)


def effective_number(weights: Float64Array) -> float:
    """(Σw)² / Σw²: as many equal weights estimate a mean as well (Kish 1965)."""
    top = weights.max()
    if top == 0:
        return 0.0
    shares = weights / top
    return float(shares.sum() ** 2 / (shares**2).sum())


def group_auc(
    scores: Float64Array,
    liked: BoolArray,
    owner: Array,
    n_users: int,
) -> tuple[Float64Array, Float64Array]:
    """Of users (U,): AUC times impressions, and these (Zhu et al., KDD 2017); both 0 for users
    whose steps are all liked or all not liked. The group AUC is the ratio of the sums.

    Args:
        scores: (N,) of the shown items, which are `liked` (N,) or not.
        owner: (N,) user of each step, 0 to n_users − 1.
    """
    import pandas as pd

    sizes = np.bincount(owner, minlength=n_users)
    ranks = pd.Series(scores).groupby(owner).rank().to_numpy()
    positive = np.bincount(owner, liked, minlength=n_users)
    negative = sizes - positive
    above = np.bincount(owner, ranks * liked, minlength=n_users) - positive * (positive + 1) / 2
    mixed = (positive > 0) & (negative > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        auc = np.where(mixed, above / (positive * negative), 0.0)
    weight = (sizes * mixed).astype(np.float64)
    return auc * weight, weight


def bootstrap_interval(values: Float64Array, seed: int) -> tuple[float, float]:
    """95% percentile bootstrap interval (low, high) of the mean of `values` (N,)."""
    means = resample_ratios(values[:, None], np.ones((len(values), 1)), seed)
    low, high = np.nanquantile(means, [0.025, 0.975])
    return float(low), float(high)


def resample_ratios(above: Float64Array, below: Float64Array, seed: int) -> Float64Array:
    """Ratios Σ above / Σ below (`_RESAMPLES`, C) of rows (N, C) drawn with replacement; NaN for
    a denominator of 0."""
    generator = np.random.default_rng(seed)
    # Multinomial counts of the rows replace copies of them, which limits memory to O(N).
    share, both = np.full(len(above), 1 / len(above)), np.hstack([above, below])
    sums = np.array([generator.multinomial(len(both), share) @ both for _ in range(_RESAMPLES)])
    numerators, denominators = np.hsplit(sums, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(denominators > 0, numerators / denominators, np.nan)
