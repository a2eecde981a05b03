"""How much weighted sessions say."""

from ucfrec.arrays import Float64Array


def effective_number(weights: Float64Array) -> float:
    """(Σw)² / Σw²: as many equal weights estimate a mean as well (Kish 1965)."""
    top = weights.max()
    if top == 0:
        return 0.0
    shares = weights / top
    return float(shares.sum() ** 2 / (shares**2).sum())
