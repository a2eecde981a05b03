"""Whether to believe an off-policy estimate, and what it says: computed, in plain words.

With true propensities, ratios have mean 1 at every step, and so have their products. Means below 1
come of choices that the logs lack or of propensities that are too large; means above 1 of too small
ones.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any, Final

import numpy as np

from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.off_policy.estimators import (
    NO_INTERVAL,
    cluster_intervals,
    cluster_mean,
    session_terms,
)
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.results.statistics import effective_number

ENOUGH_TO_TEST: Final = 30
"""Users below which a mean weight is not tested."""
ENOUGH_USERS: Final = 200
"""Effective users below which no estimate stands (`benchmarks/off_policy_coverage.py`)."""
ENOUGH_REWARDED: Final = 30
"""Users with weight and reward."""
LEAST_SHOWN: Final = 0.01
"""Share of the evaluated policy's choices below which an item group is not tested."""
DOMINANT: Final = 0.1
"""Largest share of one user in all weight."""
HEAVY_TAIL: Final = 0.5
"""Pareto shape from which on the variance is infinite, and no interval means anything."""
FAR_OFF: Final = 0.1
"""Distance of a mean session weight from 1 that counts, though no test may show it."""
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
    """(T,) effective users at each step, of the products up to it; empty of sums of sessions."""
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
    """Of the value, if propensities are true, whatever the choices that the logs lack are worth;
    up to the sampling error of PDIS. None of steps that are sums of sessions."""

    def list_columns(self) -> dict[str, Any]:
        """What speaks against the estimates, by name."""
        return {
            "overlap": self.overlap,
            "users": self.users,
            "sessions_without_propensity": self.left_out,
            "effective_users": self.effective_users,
            "effective_by_step": self.effective_by_step,
            "unsupported_from_step": self.unsupported_from_step,
            "weight_tests": [asdict(test) for test in self.tests],
            "mean_weight": self.mean_weight,
            "pareto_tail": self.tail,
            "bounds": self.bounds,
        }

    @property
    def unsupported_from_step(self) -> int | None:
        """First step (from 1) with fewer effective users than an estimate needs, if any."""
        places = enumerate(self.effective_by_step, start=1)
        return next((place for place, users in places if users < ENOUGH_USERS), None)


def diagnose(
    steps: LoggedSteps,
    reward_range: tuple[float, float] | None = None,
    segment: IntArray | None = None,
) -> Diagnosis:
    """Look for what forbids an estimate: `reward_range` is the least and greatest reward of a step,
    None for those observed; each segment (S,) of sessions, of users or weeks, is tested alone.
    """
    incomplete, users = steps.lacking, int(steps.users.max()) + 1
    if incomplete.all():
        return Diagnosis(len(incomplete), users, left_out=len(incomplete))
    weighable = steps.weighable
    weights = weighable.session_weights
    by_user = np.bincount(weighable.users, weights).astype(np.float64)
    rewarded = np.bincount(weighable.users, np.abs(weights * weighable.returns))
    # An ended session keeps the weight of its last step.
    totals, effective = np.bincount(weighable.users).astype(np.float64), []
    changes = weighable.weights - weighable.shift(weighable.weights)
    step_user = weighable.users[weighable.session]
    bounds = None
    if weighable.per_decision is None:
        for rows in weighable.rows_by_place:
            change = np.bincount(step_user[rows], changes[rows], len(totals))
            totals = np.maximum(totals + change, 0)
            effective.append(effective_number(totals))
        observed = float(steps.reward.min()), float(steps.reward.max())
        bounds = identification_bounds(weighable, reward_range or observed)
    return Diagnosis(
        sessions=len(incomplete),
        users=users,
        left_out=int(incomplete.sum()),
        overlap=float((weighable.target / weighable.propensity).mean()),
        tests=weight_tests(weighable, None if segment is None else segment[~incomplete]),
        effective_by_step=tuple(effective),
        effective_users=effective_number(by_user),
        largest_weight=float(by_user.max() / by_user.sum()) if by_user.any() else 1.0,
        rewarded_users=int((rewarded > 0).sum()),
        mean_weight=float(weights.mean()),
        tail=pareto_tail(by_user),
        bounds=bounds,
    )


def weight_tests(steps: LoggedSteps, segment: IntArray | None = None) -> tuple[WeightTest, ...]:
    """Two-sided tests that mean weights are 1: the ratios of each step, the session products, and
    those of each segment (S,) and item group. Errors are clustered by user; what fewer than 30
    users have is excluded. A mean passes within 2% of 1, or if it is not significantly away from
    it: 1% for all tests together (Bonferroni).
    """
    ratios, weights = steps.target / steps.propensity, steps.session_weights
    step_user = steps.users[steps.session]
    samples = [
        (f"step {place}", ratios[rows], step_user[rows])
        for place, rows in enumerate(steps.rows_by_place, start=1)
        if steps.per_decision is None
    ]
    samples.append((SESSION_PRODUCTS, weights, steps.users))
    for number in () if segment is None else np.unique(segment):
        inside = segment == number
        samples.append((f"segment {number}", weights[inside], steps.users[inside]))
    means = [
        (name, *cluster_mean(values, user))
        for name, values, user in samples
        if len(np.unique(user)) >= ENOUGH_TO_TEST
    ]
    if steps.groups is not None:
        for number, target in enumerate(steps.groups.target.T):
            # Over all steps, the group's ratios have the mean of its probability.
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
    """Test that weights (N,) of users (N,) have mean 1, within three standard errors."""
    mean, error = cluster_mean(weights, user)
    return WeightTest(name, mean, error, abs(mean - 1) <= _ERRORS * error)


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
    ten different values: no tail.
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
    `reward_range`, or nothing once the session, not longer than the longest logged, has ended.
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


BEST_FIRST: Final = ("DR", "SNPDIS")
"""The estimator that a verdict is about: the first of these that there is."""
_SEEN_REMOVED = (
    "such as seen items, which serve excludes without --keep-seen: evaluate with --filter-seen"
)
OTHERS_REMOVED: Final = (
    "such as items that another system removed, or that requests excluded by candidates which the "
    "logs lack: with --filter-seen, seen items are left out already"
)
"""Why logs may lack choices of a policy that is evaluated without seen items."""
_DETECTED = 1.96 + 0.84
"""Standard errors in a lift that 80% of samples would find at 95% confidence."""


@dataclass(frozen=True)
class Verdict:
    """What the logs say of the evaluated policy against the behavior policy."""

    reliable: bool
    reasons: tuple[str, ...]
    """What forbids a conclusion; empty if reliable."""
    estimator: str | None
    """Which estimate the rest is of; None where nothing could be weighed."""
    lift: float | None
    """Its value less the mean return as logged, on the same sessions."""
    lift_low: float | None
    """Ends of the 95% interval, studentised, clustered by user."""
    lift_high: float | None
    probability_better: float | None
    """Share of the bootstrap's resamples in which the lift is above 0."""
    wanted_lift: float
    sessions_needed: int | None
    """Logged sessions like these that would show `wanted_lift` in 80% of samples."""
    declared: str = ""
    """What the estimate rests on beside the logs, e.g. estimated propensities."""

    def __str__(self) -> str:
        return f"{self.headline}: {'; '.join(self.reasons)}" if self.reasons else self.headline

    @property
    def headline(self) -> str:
        """The verdict without its reasons."""
        rests_on = f" ({self.declared})" if self.declared else ""
        if not self.reliable or self.lift_low is None or self.lift_high is None:
            return f"Do not rely on this estimate{rests_on}"
        if self.lift_low > 0:
            says = "The policy has a higher return than the logged one"
        elif self.lift_high < 0:
            says = "The policy has a lower return than the logged one"
        else:
            says = "The logs do not show whether the policy or the logged one has the higher return"
        return (
            f"{says}: {self.lift:+.4g} per session [{self.lift_low:+.4g}, {self.lift_high:+.4g}] "
            f"by {self.estimator}, better with probability {self.probability_better:.3f}; a lift "
            f"of {self.wanted_lift:.4g} would show with about {self.sessions_needed or 0:,} "
            f"sessions{rests_on}"
        )


def conclude(
    steps: LoggedSteps,
    seed: int,
    diagnosis: Diagnosis | None = None,
    wanted_lift: float | None = None,
    forbidden: Sequence[str] = (),
    declared: str = "",
    filter_seen: bool = False,
) -> Verdict:
    """Compare the evaluated policy with the behavior policy, if the logs allow it, and nothing else
    is `forbidden`. `wanted_lift` is the return per session that a launch should gain; None for 5%
    of the mean logged.
    """
    diagnosis = diagnosis or diagnose(steps)
    reasons = [*forbidden, *_list_reasons(diagnosis, filter_seen)]
    if wanted_lift is None:
        wanted_lift = 0.05 * abs(float(steps.returns.mean()))
    terms = {} if steps.lacking.all() else session_terms(steps.weighable)
    name = next((name for name in BEST_FIRST if name in terms), None)
    lift = interval = needed = None
    if name is not None:
        lifts = terms[name].influences - steps.weighable.returns
        lift, ones = float(lifts.mean()), np.ones((len(lifts), 1))
        (interval,) = cluster_intervals(lifts[:, None], ones, steps.weighable.user, seed)
        if interval is None:
            reasons.append("the sessions do not differ enough for an interval")
        elif wanted_lift > 0:
            needed = math.ceil(len(lifts) * (_DETECTED * interval.error / wanted_lift) ** 2)
    low, high, _, better = interval or NO_INTERVAL
    return Verdict(
        reliable=name is not None and not reasons,
        reasons=tuple(reasons),
        estimator=name,
        lift=lift,
        lift_low=low,
        lift_high=high,
        probability_better=better,
        wanted_lift=wanted_lift,
        sessions_needed=needed,
        declared=declared,
    )


def list_cautions(diagnosis: Diagnosis, estimators: Iterable[str]) -> list[str]:
    """What to know of an estimate that may stand all the same."""
    cautions, stops = [], diagnosis.unsupported_from_step
    if 0 < diagnosis.left_out < diagnosis.sessions:
        cautions.append(
            f"{diagnosis.left_out:,} of {diagnosis.sessions:,} sessions have a step without "
            "propensity: estimates that weigh leave these sessions out"
        )
    if stops is not None:
        cautions.append(
            f"from step {stops} on fewer than {ENOUGH_USERS} effective users are left: the logs "
            "do not support an estimate there"
        )
    if "DM" in estimators:
        cautions.append("DM and FQE are only as good as their models: they carry no interval")
    if "MIPS" in estimators:
        cautions.append(
            "MIPS is right only if the reward of an item depends on its group alone: no interval"
        )
    return cautions


def _list_reasons(diagnosis: Diagnosis, filter_seen: bool) -> list[str]:
    """What forbids a conclusion, the gravest first."""
    if diagnosis.overlap is None:
        return ["no session has all its propensities, so nothing can be weighed"]
    reasons = []
    if diagnosis.left_out > MOST_LEFT_OUT * diagnosis.sessions:
        reasons.append(
            f"{diagnosis.left_out / diagnosis.sessions:.0%} of the sessions have a step without "
            f"propensity (above {MOST_LEFT_OUT:.0%}), and may differ from the rest"
        )
    mean = diagnosis.mean_weight
    if failed := [test for test in diagnosis.tests if not test.passed]:
        reasons.append(_explain_failure(failed, diagnosis, filter_seen))
    elif mean is not None and abs(mean - 1) > FAR_OFF:
        reasons.append(
            f"the mean session weight is {mean:.2f} where 1 is expected: at random, sessions that "
            f"the policy would often have are too {'rare' if mean < 1 else 'many'}; give more logs"
        )
    if not diagnosis.rewarded_users:
        reasons.append("no session has both weight and reward: the logs support no estimate")
    elif diagnosis.rewarded_users < ENOUGH_REWARDED:
        reasons.append(
            f"only {diagnosis.rewarded_users} users have both weight and reward (below "
            f"{ENOUGH_REWARDED})"
        )
    if diagnosis.effective_users < ENOUGH_USERS:
        reasons.append(
            f"the weights leave {diagnosis.effective_users:,.0f} effective of {diagnosis.users:,} "
            f"users (below {ENOUGH_USERS})"
        )
    if diagnosis.largest_weight > DOMINANT:
        reasons.append(f"one user has {diagnosis.largest_weight:.0%} of all weight")
    if diagnosis.tail is not None and diagnosis.tail > HEAVY_TAIL:
        reasons.append(
            f"the weights have too heavy a tail (Pareto k {diagnosis.tail:.2f}, above {HEAVY_TAIL})"
        )
    return reasons


def _explain_failure(failed: list[WeightTest], diagnosis: Diagnosis, filter_seen: bool) -> str:
    """What the worst of the failed tests shows."""

    def rank(test: WeightTest) -> tuple[bool, float]:
        # The products show the size of the error; else the test that is furthest off.
        return test.name == SESSION_PRODUCTS, abs(math.log(max(test.mean, 1e-12)))

    worst = max(failed, key=rank)
    alone = len(failed) == 1 and worst.name == SESSION_PRODUCTS
    # Where few users have most of the weight, tests that take means for normal reject too often.
    few_weigh = (diagnosis.tail or 0.0) > HEAVY_TAIL or diagnosis.effective_users < ENOUGH_USERS
    if worst.mean >= 1:
        return f"{worst}, where 1 is expected: propensities are too small"
    if alone and few_weigh:
        cause = (
            "sessions that the policy would often have may be too rare in these logs: give more "
            "logs; or the logs lack choices that the policy makes"
        )
    else:
        removed = OTHERS_REMOVED if filter_seen else _SEEN_REMOVED
        cause = (
            f"the logs lack choices that the policy makes ({removed}), or propensities are too "
            "large"
        )
    reason = f"{worst}, where 1 is expected: {cause}"
    if diagnosis.bounds is None:
        return reason
    low, high = diagnosis.bounds
    return f"{reason} (if they are right, the value lies between {low:.4g} and {high:.4g})"
