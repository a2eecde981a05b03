"""Whether to believe an off-policy estimate: tests of the weights, and reasons in plain words.

With true propensities, ratios have mean 1 at every step, and so have their products. Means below 1
come of choices that the logs lack or of propensities that are too large; means above 1 of too small
ones.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.off_policy.estimators import cluster_mean, largest_share
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.results.statistics import effective_number

ENOUGH_TO_TEST = 30
"""Users below which a mean weight is not tested."""
ENOUGH_USERS = 200
"""Effective users below which no estimate stands (`benchmarks/off_policy_coverage.py`)."""
ENOUGH_REWARDED = 30
"""Users with weight and reward."""
LEAST_SHOWN = 0.01
"""Share of the evaluated policy's choices below which an item group is not tested."""
DOMINANT = 0.1
"""Largest share of one user in all weight."""
LARGE = 10.0
"""Returns of so many times the mean of those that are not 0 make a sum of rewards uneven."""
HEAVY_TAIL = 0.5
"""Pareto shape from which on the variance is infinite, and no interval means anything."""
FAR_OFF = 0.1
"""Distance of a mean session weight from 1 that counts, though no test may show it."""
MOST_LEFT_OUT = 0.05
"""Largest share of sessions, or rows, without which an estimate stands."""
_MANY_VALUES = 10
"""Different propensities that few decimals do not have by design."""
_SIGNIFICANCE, _TOLERANCE = 0.01, 0.02
SESSION_PRODUCTS = "session products"


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
    left_out: int = 0
    """Sessions with a step of unknown propensity: no part of what follows."""
    overlap: float | None = None
    """Mean ratio of steps; None where nothing can be weighed, as in the rest."""
    tests: tuple[WeightTest, ...] = ()
    effective_users: float = 0.0
    """Of the session products, summed by user."""
    largest_weight: float = 1.0
    """Share of the heaviest user in all weight."""
    rewarded_users: int = 0
    """Users with a session that has both weight and reward."""
    largest_return: float = 0.0
    """Largest share of one user in the weighted returns; 0 if no return is `LARGE`."""
    mean_weight: float | None = None
    """Mean session product, 1 in expectation."""
    tail: float | None = None
    """Shape k of the Pareto tail of the weights (`pareto_tail`)."""

    def list_columns(self) -> dict[str, Any]:
        """What speaks against the estimates, by name."""
        return {
            "overlap": self.overlap,
            "users": self.users,
            "sessions_without_propensity": self.left_out,
            "effective_users": self.effective_users,
            "weight_tests": [asdict(test) for test in self.tests],
            "mean_weight": self.mean_weight,
            "pareto_tail": self.tail,
        }


def diagnose(steps: LoggedSteps, segment: IntArray | None = None) -> Diagnosis:
    """Look for what forbids an estimate; each segment (S,) of sessions is tested alone."""
    incomplete, users = steps.lacking, int(steps.users.max()) + 1
    if incomplete.all():
        return Diagnosis(len(incomplete), users, left_out=len(incomplete))
    weighable = steps.weighable
    weights = weighable.session_weights
    by_user = np.bincount(weighable.users, weights).astype(np.float64)
    sizes = np.abs(weighable.returns)
    rewarded = np.bincount(weighable.users, weights * sizes).astype(float)
    are_uneven = sizes.max() * np.count_nonzero(sizes) > LARGE * sizes.sum()
    return Diagnosis(
        sessions=len(incomplete),
        users=users,
        left_out=int(incomplete.sum()),
        overlap=float((weighable.target / weighable.propensity).mean()),
        tests=weight_tests(weighable, None if segment is None else segment[~incomplete]),
        effective_users=effective_number(by_user),
        largest_weight=largest_share(by_user),
        rewarded_users=int((rewarded > 0).sum()),
        largest_return=largest_share(rewarded) if are_uneven else 0.0,
        mean_weight=float(weights.mean()),
        tail=pareto_tail(by_user),
    )


def weight_tests(steps: LoggedSteps, segment: IntArray | None = None) -> tuple[WeightTest, ...]:
    """Two-sided tests that mean weights are 1: the ratios of each step, the session products, and
    those of each segment (S,) and item group. Errors are clustered by user; what fewer than 30
    users have is excluded. A mean passes within 2% of 1, or if it is not significantly away from
    it: 1% for all tests together (Bonferroni). As weights are skewed, a mean is below 1 more often
    than a normal one, which Hall's cubic transformation corrects (J. R. Stat. Soc. B 1992).
    """
    means = []
    for name, values, user in _iterate_weights(steps, segment):
        if len(np.unique(user)) >= ENOUGH_TO_TEST:
            mean, error = cluster_mean(values, user)
            scale = max(error, 1e-12)
            t = (mean - 1) / scale
            sums = np.bincount(user, values - mean)
            shares = sums / scale / len(values)
            skew = float((shares**3).sum()) / 3
            distance = t + skew * (t**2 + skew * t**3 / 3 + 0.5)
            means.append((name, mean, error, abs(distance)))
    limit = NormalDist().inv_cdf(1 - _SIGNIFICANCE / (2 * max(len(means), 1)))
    return tuple(
        WeightTest(name, mean, error, abs(mean - 1) <= _TOLERANCE or distance <= limit)
        for name, mean, error, distance in means
    )


def _iterate_weights(
    steps: LoggedSteps, segment: IntArray | None
) -> Iterator[tuple[str, Float64Array, IntArray]]:
    """Name, values and users of what has a mean of 1."""
    ratios = steps.target / steps.propensity
    weights = steps.session_weights
    step_user = steps.users[steps.session]
    for place, rows in enumerate(steps.rows_by_place, start=1):
        yield f"step {place}", ratios[rows], step_user[rows]
    yield SESSION_PRODUCTS, weights, steps.users
    for number in () if segment is None else np.unique(segment):
        inside = segment == number
        yield f"segment {number}", weights[inside], steps.users[inside]
    if steps.groups is None:
        return
    for number, target in enumerate(steps.groups.target.T):
        # Over all steps, the group's ratios have the mean of its probability.
        inside = steps.groups.number == number
        share = target.mean(dtype=np.float64)
        if len(np.unique(step_user[inside])) >= ENOUGH_TO_TEST and share >= LEAST_SHOWN:
            beyond = (np.where(inside, ratios, 0.0) - target) / share
            yield f"item group {number}", 1 + beyond, step_user


def describe_rounding(propensity: Float64Array) -> str:
    """What to say of propensities (N,) with few decimals and yet many values; "" of others."""
    for decimals in (1, 2, 3):
        rounded = np.round(propensity, decimals)
        if np.allclose(rounded, propensity, rtol=0, atol=1e-6, equal_nan=True):
            if len(np.unique(rounded)) < _MANY_VALUES:
                return ""
            error = 0.5 * 0.1**decimals / np.nanmin(propensity)
            text = f"propensities have {decimals} decimals: if they were rounded, weights are wrong"
            return f"{text} by up to {error:.0%}; log all digits"
    return ""


def check_catalogue_size(
    steps: LoggedSteps, in_catalogue: BoolArray, items: int
) -> WeightTest | None:
    """One-sided test, at 1%, that the mean of 1 / propensity over the logged choices in the
    catalogue (N,), the number of items that the behavior policy chose from, is at most `items`;
    None with fewer than 30 users that have a propensity."""
    rows = np.flatnonzero(~np.isnan(steps.propensity))
    user = steps.users[steps.session[rows]]
    if len(np.unique(user)) < ENOUGH_TO_TEST:
        return None
    shares = np.where(in_catalogue[rows], 1 / steps.propensity[rows], 0.0) / items
    mean, error = cluster_mean(shares, user)
    passed = mean - 1 <= max(_TOLERANCE, NormalDist().inv_cdf(1 - _SIGNIFICANCE) * error)
    return WeightTest("items to choose from", mean, error, passed)


def pareto_tail(weights: Float64Array) -> float | None:
    """Shape k of a generalised Pareto distribution fitted to the largest weights (n,).

    From 0.5 on the variance is infinite (Vehtari, Simpson, Gelman, Yao & Gabry, JMLR 2024). Fitted
    by Zhang & Stephens, Technometrics 2009. None where the largest fifth, or 3√n, have fewer than
    ten different values, up to rounding errors of the mean: no tail.
    """
    size = int(min(0.2 * len(weights), 3 * len(weights) ** 0.5))
    ordered = np.sort(np.round(weights / (weights.mean() or 1.0), 4))
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


def list_reasons(diagnosis: Diagnosis) -> list[str]:
    """What forbids a conclusion, the gravest first."""
    if diagnosis.left_out == diagnosis.sessions:
        return ["no session has all its propensities, so nothing can be weighed"]
    reasons = []
    if diagnosis.left_out > MOST_LEFT_OUT * diagnosis.sessions:
        reasons.append(
            f"{diagnosis.left_out / diagnosis.sessions:.0%} of the sessions have a step without "
            f"propensity (above {MOST_LEFT_OUT:.0%}), and may differ from the rest"
        )
    if (effective := diagnosis.effective_users) < ENOUGH_USERS:
        users = f"{effective:,.0f} effective of {diagnosis.users:,} users"
        reasons.append(f"the weights leave {users} (below {ENOUGH_USERS})")
    mean = diagnosis.mean_weight
    if failed := [test for test in diagnosis.tests if not test.passed]:
        reasons.append(_explain_failure(failed))
    elif mean is not None and abs(mean - 1) > FAR_OFF:
        reasons.append(
            f"the mean weight is {mean:.2f} where 1 is expected: at random, what the policy would "
            f"often show is too {'rare' if mean < 1 else 'frequent'}; give more logs"
        )
    if not (count := diagnosis.rewarded_users):
        reasons.append("no session has both weight and reward: the logs support no estimate")
    elif count < ENOUGH_REWARDED:
        reasons.append(f"only {count} users have both weight and reward (below {ENOUGH_REWARDED})")
    if diagnosis.largest_weight > DOMINANT:
        reasons.append(f"one user has {diagnosis.largest_weight:.0%} of all weight")
    elif diagnosis.largest_return > DOMINANT and count >= ENOUGH_REWARDED:
        share = f"{diagnosis.largest_return:.0%} of all weighted reward"
        remedy = "cap rewards, as in least(revenue, 500), or give more logs"
        reasons.append(f"one user has {share}: {remedy}")
    if (tail := diagnosis.tail or 0.0) > HEAVY_TAIL:
        reasons.append(f"weights have too heavy a tail (Pareto k {tail:.2f}, above {HEAVY_TAIL})")
    return reasons


def _explain_failure(failed: list[WeightTest]) -> str:
    """What the worst of the failed tests shows."""
    # The products show the size of the error; else the test that is furthest off.
    products = [test for test in failed if test.name == SESSION_PRODUCTS]
    worst = max(products or failed, key=lambda test: abs(math.log(max(test.mean, 1e-12))))
    if worst.mean >= 1:
        return f"{worst}, where 1 is expected: propensities are too small"
    return (
        f"{worst}, where 1 is expected: the logs lack choices that the policy makes, such as seen "
        "items or what requests exclude (log excludes_seen and candidates), or propensities are "
        "too large"
    )
