"""How much weighted sessions say: effective number, and the tail of the weights."""

import numpy as np

from ucfrec.arrays import Float64Array


def effective_number(weights: Float64Array) -> float:
    """(Σw)² / Σw²: as many equal weights estimate a mean as well (Kish 1965)."""
    top = weights.max()
    if top == 0:
        return 0.0
    shares = weights / top
    return float(shares.sum() ** 2 / (shares**2).sum())


def pareto_tail(weights: Float64Array) -> float | None:
    """Shape k of a generalised Pareto distribution fitted to the largest weights.

    From 0.5 on the variance is infinite; from 0.7 on a mean, and its interval, is unreliable
    whatever the sample (Vehtari, Simpson, Gelman, Yao & Gabry, JMLR 2024). Fitted by Zhang &
    Stephens, Technometrics 2009.

    Args:
        weights: (n,).

    Returns:
        None where the largest fifth, or 3√n, have fewer than ten different values: no tail.
    """
    size = tail_size(len(weights))
    ordered = np.sort(weights)
    excess = ordered[len(weights) - size :] - ordered[max(len(weights) - size - 1, 0)]
    excess = excess[excess > 0]
    if len(np.unique(excess)) < 10:
        return None
    excess = excess / excess[-1]
    n, grid = len(excess), 30 + int(len(excess) ** 0.5)
    quartile = excess[int(n / 4 + 0.5) - 1]
    theta = 1 + (1 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3 * quartile)
    shapes = np.log1p(-theta[:, None] * excess).mean(axis=1)
    likelihood = n * (np.log(-theta / shapes) - shapes - 1)
    posterior = np.exp(likelihood - likelihood.max())
    best = float((theta * posterior).sum() / posterior.sum())
    return float(np.log1p(-best * excess).mean())


def tail_size(n: int) -> int:
    """Largest of n weights that `pareto_tail` looks at: a fifth, or 3√n."""
    return int(min(0.2 * n, 3 * n**0.5))
