"""What in the logs speaks against an off-policy estimate: support, weights, tails, missing numbers.

Notation as in `ucfrec.off_policy.logged_steps`. With true propensities, and a behavior policy that
could choose whatever the evaluated policy may, ratios have mean 1 at every step, and so have their
products. Means below 1 come of choices that the logs lack or of propensities that are too large;
means above 1 of propensities that are too small.
"""

from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np

from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.off_policy.intervals import cluster_mean
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.results.statistics import effective_number

ENOUGH_TO_TEST: Final = 30
"""Users below which a mean weight is not tested."""
ENOUGH_USERS: Final = 200
"""Effective users below which no estimate stands: in `benchmarks/off_policy_coverage.py` intervals
of fewer hold the truth too seldom."""
ENOUGH_REWARDED: Final = 30
"""Users with weight and reward."""
LEAST_SHOWN: Final = 0.01
"""Share of the evaluated policy's choices below which an item group is not tested."""
DOMINANT: Final = 0.1
"""Largest share of one user in all weight."""
HEAVY_TAIL: Final = 0.5
"""Pareto shape from which on the variance is infinite, and no interval means anything."""
FAR_OFF: Final = 0.1
"""A mean session weight further from 1 shows that the heaviest sessions are missing, or too many,
though their number may be too small for a test to show it."""
MOST_LEFT_OUT: Final = 0.05
"""Largest share of sessions, or rows, without which an estimate stands."""
_SIGNIFICANCE, _TOLERANCE, _ERRORS = 0.01, 0.02, 3.0
SESSION_PRODUCTS: Final = "session products"


@dataclass(frozen=True)
class WeightTest:
    """A mean weight that should be 1."""

    name: str
    mean: float
    error: float
    """Standard error over users."""
    passed: bool

    def __str__(self) -> str:
        return f"{self.name}: mean weight {self.mean:.3g} ± {self.error:.2g}"


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` finds in logs."""

    sessions: int
    users: int
    left_out: int
    """Sessions with a step of unknown propensity: no part of what follows."""
    overlap: float | None = None
    """Mean ratio of steps; None where nothing can be weighed, as in the rest."""
    tests: tuple[WeightTest, ...] = ()
    effective_by_step: tuple[float, ...] = ()
    """(T,) effective users at each step, of the products up to it; empty of steps that are sums of
    sessions."""
    effective_users: float = 0.0
    """Of the session products, summed by user."""
    largest_weight: float = 1.0
    """Share of the heaviest user in all weight."""
    rewarded_users: int = 0
    """Users with a session that has both weight and reward."""
    mean_weight: float | None = None
    """Mean session product, 1 in expectation."""
    tail: float | None = None
    """Shape k of the Pareto tail of the weights (`pareto_tail`)."""
    bounds: tuple[float, float] | None = None
    """Between these lies the value if the propensities are true, whatever the choices that the logs
    lack are worth; up to the sampling error of PDIS. None of steps that are sums of sessions."""

    @property
    def few_weigh(self) -> bool:
        """Whether few users have most of the weight: then tests of weights, which take means for
        normal, reject too often."""
        return (self.tail or 0.0) > HEAVY_TAIL or self.effective_users < ENOUGH_USERS

    @property
    def unsupported_from_step(self) -> int | None:
        """First step (from 1) with fewer effective users than an estimate needs; None if the logs
        suffice to the end."""
        few = [n < ENOUGH_USERS for n in self.effective_by_step]
        return few.index(True) + 1 if any(few) else None


def diagnose(
    steps: LoggedSteps,
    reward_range: tuple[float, float] | None = None,
    segment: IntArray | None = None,
) -> Diagnosis:
    """Look for what forbids an estimate.

    Args:
        reward_range: least and greatest reward of a step; None for those observed.
        segment: (S,) number of each session's segment (of users, of weeks, of contexts known before
            the first choice), each of which is tested alone.
    """
    incomplete, users = steps.lacking, int(steps.users.max()) + 1
    if incomplete.all():
        return Diagnosis(len(incomplete), users, left_out=len(incomplete))
    known = steps.weighable
    weights = known.session_weights
    by_user = np.bincount(known.users, weights).astype(np.float64)
    rewarded = np.bincount(known.users, np.abs(weights * known.returns))
    summed = known.per_decision is not None
    reward_range = reward_range or (float(steps.reward.min()), float(steps.reward.max()))
    return Diagnosis(
        sessions=len(incomplete),
        users=users,
        left_out=int(incomplete.sum()),
        overlap=float((known.target / known.propensity).mean()),
        tests=weight_tests(known, None if segment is None else segment[~incomplete]),
        effective_by_step=() if summed else _effective_by_step(known),
        effective_users=effective_number(by_user),
        largest_weight=float(by_user.max() / by_user.sum()) if by_user.any() else 1.0,
        rewarded_users=int((rewarded > 0).sum()),
        mean_weight=float(weights.mean()),
        tail=pareto_tail(by_user),
        bounds=None if summed else identification_bounds(known, reward_range),
    )


def weight_tests(steps: LoggedSteps, segment: IntArray | None = None) -> tuple[WeightTest, ...]:
    """Two-sided tests that mean weights are 1: the ratios of each step, the session products, and
    those of each segment and item group. Errors are clustered by user; what fewer than 30 users
    have is excluded. A mean passes within 2% of 1, or if it is not significantly away from it: 1%
    for all tests together (Bonferroni).

    Over all steps, the ratios of an item group's own have the mean of the evaluated policy's
    probability of the group; their quotient is tested.

    Args:
        segment: (S,) as `diagnose` takes it.
    """
    ratios, weights = steps.target / steps.propensity, steps.session_weights
    step_user = steps.users[steps.session]
    samples = []
    # Of sums of sessions the ratios are the session products.
    for place, rows in enumerate(_rows_by_place(steps) if steps.per_decision is None else []):
        samples.append((f"step {place + 1}", ratios[rows], step_user[rows]))
    samples.append((SESSION_PRODUCTS, weights, steps.users))
    for number in [] if segment is None else np.unique(segment):
        inside = segment == number
        samples.append((f"segment {number}", weights[inside], steps.users[inside]))
    means = [
        (name, *cluster_mean(values, user))
        for name, values, user in samples
        if len(np.unique(user)) >= ENOUGH_TO_TEST
    ]
    if steps.groups is not None:
        for number, target in enumerate(steps.groups.target.T):
            inside = steps.groups.number == number
            expected = target.astype(np.float64)
            share = float(expected.mean())
            if len(np.unique(step_user[inside])) >= ENOUGH_TO_TEST and share >= LEAST_SHOWN:
                beyond = (np.where(inside, ratios, 0.0) - expected) / share
                mean, error = cluster_mean(beyond, step_user)
                means.append((f"item group {number}", 1 + mean, error))
    limit = NormalDist().inv_cdf(1 - _SIGNIFICANCE / (2 * max(len(means), 1)))
    return tuple(
        WeightTest(name, mean, error, abs(mean - 1) <= max(_TOLERANCE, limit * error))
        for name, mean, error in means
    )


def check_mean_weight(name: str, weights: Float64Array, user: IntArray) -> WeightTest:
    """One test that weights (N,) of users (N,) have mean 1: within three standard errors."""
    mean, error = cluster_mean(weights, user)
    return WeightTest(name, mean, error, abs(mean - 1) <= _ERRORS * error)


def implied_items(steps: LoggedSteps, listed: BoolArray, items: int) -> WeightTest | None:
    """Test that the propensities of a catalogue can add up to 1.

    The mean of 1 / propensity over the logged choices among `items` items is the number of these
    that the behavior policy chose from, at most all of them. So the test is one-sided, at 1%.

    Args:
        listed: (N,) whether the logged item is one of the items.

    Returns:
        The implied share of the items as a test, errors clustered by user; None with fewer than 30
        users, or without propensities.
    """
    known = ~np.isnan(steps.propensity)
    user = steps.users[steps.session]
    if not known.any() or len(np.unique(user[known])) < ENOUGH_TO_TEST:
        return None
    shares = np.where(listed[known], 1 / steps.propensity[known], 0.0) / items
    mean, error = cluster_mean(shares, user[known])
    limit = NormalDist().inv_cdf(1 - _SIGNIFICANCE)
    passed = mean - 1 <= max(_TOLERANCE, limit * error)
    return WeightTest("items to choose from", mean, error, passed)


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
    size = int(min(0.2 * len(weights), 3 * len(weights) ** 0.5))
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


def identification_bounds(
    steps: LoggedSteps, reward_range: tuple[float, float]
) -> tuple[float, float]:
    """PDIS plus the least and the most that choices without support could return.

    At step t a share 1 − E_n[w_t] of the evaluated policy's sessions has left what the logs support
    (Manski 1990, for weights: Khan et al., AISTATS 2024); each of their steps has a reward in
    `reward_range`, or nothing once the session has ended. No session is longer than the longest
    logged.
    """
    totals = steps.step_totals() / len(steps.first)
    unsupported = np.maximum(1 - totals, 0)
    worth = float((steps.discount ** np.arange(len(totals)) * unsupported).sum())
    supported = steps.per_session(steps.discounts * steps.weights * steps.reward).mean()
    low, high = reward_range
    # A single step is always taken; a longer session may end.
    if len(totals) > 1:
        low, high = min(low, 0.0), max(high, 0.0)
    return float(supported + worth * low), float(supported + worth * high)


def _rows_by_place(steps: LoggedSteps) -> list[IntArray]:
    """The rows of every place in a session, sessions in order."""
    order = np.argsort(steps.step, kind="stable")
    return np.split(order, np.cumsum(np.bincount(steps.step))[:-1])


def _effective_by_step(steps: LoggedSteps) -> tuple[float, ...]:
    users, weights = steps.users, steps.weights
    changes = weights - steps.shift(weights)
    # An ended session keeps the weight of its last step.
    totals, effective = np.bincount(users).astype(np.float64), []
    for rows in _rows_by_place(steps):
        change = np.bincount(users[steps.session[rows]], changes[rows], len(totals))
        totals = np.maximum(totals + change, 0)
        effective.append(effective_number(totals))
    return tuple(effective)
