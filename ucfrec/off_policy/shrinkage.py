"""Estimators that shrink large weights: a little bias for much less variance.

Each is E_n[v + ŵ (r − q)], with q = v = 0 for the IPS kinds, and takes ŵ(w; λ) for the weight w:

| name | ŵ(w; λ) | source |
|---|---|---|
| clipped IPS | min(w, λ) | Ionides 2008; Bottou et al., JMLR 2013 |
| sub-Gaussian IPS, sub-Gaussian DR | w / (1 − λ + λ w) | Metelli, Russo & Restelli, NeurIPS 2021 |
| SWITCH-DR | w where w ≤ λ, else 0 | Wang, Agarwal & Dudík, ICML 2017 |
| DRos | λ w / (w² + λ) | Su, Dimakopoulou, Krishnamurthy & Dudík, ICML 2020 |

The IPS kinds shrink the weight of the whole session; the DR kinds are for sessions of one step.
λ has the least estimated mean squared error of the candidates (Su et al. 2020, section 5): the
sample variance over n plus the square of the estimated bias E_n[(w − ŵ)(r − q)]. Their bound on
that bias does not depend on λ and, with logs of 500 sessions and lognormal weights, never shrinks
anything; the plain estimate of it lowers the error there by a tenth to a third. Where any weight is
shrunk there is no interval: resampling with λ as given knows nothing of the bias.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ucfrec.arrays import Float64Array
from ucfrec.off_policy.logged_steps import LoggedSteps

Shrink = Callable[[Float64Array, float], Float64Array]


def clip(weights: Float64Array, most: float) -> Float64Array:
    """min(w, λ)."""
    return np.minimum(weights, most)


def switch(weights: Float64Array, most: float) -> Float64Array:
    """w where w ≤ λ, else 0."""
    return np.where(weights <= most, weights, 0.0)


def optimistic(weights: Float64Array, strength: float) -> Float64Array:
    """λ w / (w² + λ): w where λ is infinite, 0 where it is 0."""
    if math.isinf(strength):
        return weights
    return np.asarray(strength * weights / np.maximum(weights**2 + strength, 1e-300))


def sub_gaussian(weights: Float64Array, strength: float) -> Float64Array:
    """w / (1 − λ + λ w): w where λ is 0, 1 where it is 1."""
    return np.asarray(weights / np.maximum(1 - strength + strength * weights, 1e-300))


@dataclass(frozen=True)
class Shrinkage:
    """One way to shrink weights, and the parameters to choose from."""

    shrink: Shrink
    candidates: tuple[float, ...]


_BOUNDS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0, math.inf)
_CLIP = Shrinkage(clip, _BOUNDS)
_SUB_GAUSSIAN = Shrinkage(sub_gaussian, (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0))
IPS_KINDS: Final = {"clipped IPS": _CLIP, "sub-Gaussian IPS": _SUB_GAUSSIAN}
DR_KINDS: Final = {
    "SWITCH-DR": Shrinkage(switch, (0.0, *_BOUNDS)),
    "DRos": Shrinkage(optimistic, (0.0, *_BOUNDS[:-1], 1e4, 1e5, math.inf)),
    "sub-Gaussian DR": _SUB_GAUSSIAN,
}


def shrunk(steps: LoggedSteps) -> dict[str, tuple[float, Float64Array, Float64Array]]:
    """Of each estimator: the tuned parameter, the terms (S,) whose mean is the estimate, and the
    shrunk weights (S,). Propensities of all steps are known."""
    weights, nothing = steps.session_weights, np.zeros(len(steps.first))
    found = {
        name: _tuned(kind, weights, steps.returns, nothing) for name, kind in IPS_KINDS.items()
    }
    if steps.model is not None and len(steps.session) == len(steps.first):
        left, value = steps.reward - steps.model.q, steps.model.v
        found |= {name: _tuned(kind, weights, left, value) for name, kind in DR_KINDS.items()}
    return found


def _tuned(
    kind: Shrinkage, weights: Float64Array, left: Float64Array, value: Float64Array
) -> tuple[float, Float64Array, Float64Array]:
    parameter = tune(kind.shrink, kind.candidates, weights, left, value)
    kept = kind.shrink(weights, parameter)
    return parameter, value + kept * left, kept


def tune(
    shrink: Shrink,
    candidates: Sequence[float],
    weights: Float64Array,
    left: Float64Array,
    value: Float64Array,
) -> float:
    """The candidate of least estimated mean squared error, the first of equals.

    Args:
        weights: (S,) unshrunk.
        left: (S,) r − q.
        value: (S,) v.
    """
    errors = [
        mean_squared_error(weights, shrink(weights, candidate), left, value)
        for candidate in candidates
    ]
    return candidates[int(np.argmin(errors))]


def mean_squared_error(
    weights: Float64Array, kept: Float64Array, left: Float64Array, value: Float64Array
) -> float:
    """Estimated mean squared error of E_n[value + kept · left] (Su et al. 2020, section 5)."""
    bias = float(((weights - kept) * left).mean())
    return float(np.var(value + kept * left)) / len(weights) + bias**2
