"""Group AUC: how well scores rank each user's liked steps above the user's other steps."""

import numpy as np

from ucfrec.arrays import Array, BoolArray, Float64Array


def group_auc(
    scores: Float64Array, liked: BoolArray, owner: Array, n_users: int
) -> tuple[Float64Array, Float64Array]:
    """Per user: AUC times impressions, and impressions (Zhu et al., KDD 2017).

    Both are 0 for users whose steps are all liked or all not liked. The group AUC is the ratio of
    the sums.

    Args:
        scores: (N,) of the shown items.
        liked: (N,).
        owner: (N,) user of each step, 0 to n_users − 1.
        n_users: U.

    Returns:
        Two arrays (U,).
    """
    from scipy.stats import rankdata

    sizes = np.bincount(owner, minlength=n_users)
    _, level = np.unique(scores, return_inverse=True)
    # Ranks within users: ranks of (user, score) minus the number of steps of earlier users.
    ranks = rankdata(owner * len(scores) + level) - (np.cumsum(sizes) - sizes)[owner]
    positive = np.bincount(owner, liked, minlength=n_users)
    negative = sizes - positive
    above = np.bincount(owner, ranks * liked, minlength=n_users) - positive * (positive + 1) / 2
    mixed = (positive > 0) & (negative > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        auc = np.where(mixed, above / (positive * negative), 0.0)
    weight = (sizes * mixed).astype(np.float64)
    return auc * weight, weight


def ratio_with_error(above: Float64Array, below: Float64Array) -> tuple[float, float]:
    """Σ above / Σ below over users (U,), and its standard error by linearisation; NaN for 0 / 0."""
    total = below.sum()
    if total == 0:
        return float("nan"), float("nan")
    ratio = above.sum() / total
    return float(ratio), float(np.sqrt(np.square(above - ratio * below).sum()) / total)
