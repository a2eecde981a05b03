"""What a policy would have earned a session, from logs of another: arrays in, estimates out."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ucfrec.errors import InputError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_RESAMPLES = 2000


@dataclass(frozen=True)
class LoggedSteps:
    """N logged steps of S sessions, a session's steps together and in order."""

    session: IntArray
    """(N,) number of each step's session: 0 to S − 1, never falling."""
    reward: FloatArray
    propensity: FloatArray
    """(N,) the behavior policy's probability of the logged action."""
    target: FloatArray
    """(N,) the judged policy's probability of it."""
    q: FloatArray | None = None
    """(N,) return from the logged action on, under the target; fitted on other sessions."""
    v: FloatArray | None = None
    """(N,) the mean of `q` over the target's actions."""


@dataclass(frozen=True)
class Estimate:
    """Mean return a session, its 95% percentile bootstrap interval over sessions."""

    value: float
    low: float
    high: float
    effective_sessions: float
    """(Σw)² / Σw² of the sessions' weights (Kish 1965); S where nothing is weighted."""


def estimate(steps: LoggedSteps, seed: int) -> dict[str, Estimate]:
    """IPS, SNIPS and PDIS, and DM and DR where `q` and `v` are given.

    IPS weights a session's return by the product of its ratios, PDIS each reward by the product up
    to its step (Precup 2000); SNIPS divides IPS by the mean weight of sessions (Swaminathan &
    Joachims 2015); DM is v at a session's first step; DR adds the weighted errors of the model
    (Dudík 2011, over sessions Jiang & Li 2016).

    Raises:
        InputError: propensities are not in (0, 1].
    """
    if not ((steps.propensity > 0) & (steps.propensity <= 1)).all():
        raise InputError("propensities must be above 0 and at most 1; correct that column")
    first = np.flatnonzero(np.diff(steps.session, prepend=-1))
    last = np.append(first[1:], len(steps.session)) - 1
    upto = _cumulative_ratios(steps, first)
    weights, ones = upto[last], np.ones(len(first))
    returns = np.add.reduceat(steps.reward, first)
    earned = {
        "IPS": (weights * returns, ones, weights),
        "SNIPS": (weights * returns, weights, weights),
        "PDIS": (np.add.reduceat(upto * steps.reward, first), ones, weights),
    }
    if steps.q is not None and steps.v is not None:
        before = np.roll(upto, 1)
        before[first] = 1.0
        corrected = upto * (steps.reward - steps.q) + before * steps.v
        earned["DM"] = (steps.v[first], ones, ones)
        earned["DR"] = (np.add.reduceat(corrected, first), ones, weights)
    return {name: _with_interval(*parts, seed) for name, parts in earned.items()}


def _cumulative_ratios(steps: LoggedSteps, first: IntArray) -> FloatArray:
    """(N,) product of target / propensity from the session's first step on."""
    never = steps.target == 0
    logs = np.log(np.where(never, 1.0, steps.target / steps.propensity))

    def within(values: FloatArray) -> FloatArray:
        total = np.cumsum(values)
        return np.asarray(total - (total - values)[first][steps.session])

    return np.where(within(never.astype(np.float64)) > 0, 0.0, np.exp(within(logs)))


def _with_interval(
    above: FloatArray, below: FloatArray, weights: FloatArray, seed: int
) -> Estimate:
    if not weights.any():
        return Estimate(float("nan"), float("nan"), float("nan"), 0.0)
    generator = np.random.default_rng(seed)
    share = np.full(len(above), 1 / len(above))
    counts = (generator.multinomial(len(above), share) for _ in range(_RESAMPLES))
    sums = np.array([(count @ above, count @ below) for count in counts])
    drawn = sums[sums[:, 1] > 0]
    low, high = np.quantile(drawn[:, 0] / drawn[:, 1], [0.025, 0.975])
    effective = float(weights.sum() ** 2 / (weights**2).sum())
    return Estimate(float(above.sum() / below.sum()), float(low), float(high), effective)
