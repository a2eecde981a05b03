"""Whether to believe an off-policy estimate, and what it says: computed, in plain words."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ucfrec.off_policy.diagnostics import ENOUGH_USERS, SESSION_PRODUCTS, Diagnosis, diagnose
from ucfrec.off_policy.estimators import Estimate, Terms, session_terms
from ucfrec.off_policy.intervals import Interval, cluster_intervals
from ucfrec.off_policy.logged_steps import LoggedSteps

BEST_FIRST: Final = ("DR", "SNPDIS")
"""The estimator that a verdict is about: the first of these that there is."""
DOMINANT: Final = 0.1
HEAVY_TAIL: Final = 0.5
"""Pareto shape from which on the variance is infinite, and no interval means anything."""
FAR_OFF: Final = 0.1
"""A mean session weight further from 1 shows that the heaviest sessions are missing, or too many,
though their number may be too small for a test to show it."""
ENOUGH_REWARDED: Final = 30
MOST_LEFT_OUT: Final = 0.05
_SEEN_REMOVED: Final = (
    "such as seen items, which serve excludes without --keep-seen: evaluate with --filter-seen"
)
OTHERS_REMOVED: Final = (
    "such as items that requests excluded by candidates, or that another system removed: with "
    "--filter-seen, seen items are left out already"
)
"""Why logs may lack choices of a policy that is evaluated without seen items."""
_DETECTED: Final = 1.96 + 0.84
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
        if not self.reliable or self.lift_low is None or self.lift_high is None:
            return f"Do not rely on this estimate{self._rests_on}"
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
            f"sessions{self._rests_on}"
        )

    @property
    def _rests_on(self) -> str:
        return f" ({self.declared})" if self.declared else ""


def conclude(
    steps: LoggedSteps,
    seed: int,
    diagnosis: Diagnosis | None = None,
    wanted_lift: float | None = None,
    forbidden: Sequence[str] = (),
    declared: str = "",
    filter_seen: bool = False,
) -> Verdict:
    """Compare the evaluated policy with the behavior policy, if the logs allow it.

    Args:
        seed: draws the bootstrap's resamples.
        diagnosis: of the same steps; None to make it.
        wanted_lift: return per session that a launch should gain; None for 5% of the mean logged
            return.
        forbidden: what else the caller knows to forbid a conclusion.
        declared: what the estimate rests on beside the logs, said with the verdict.
        filter_seen: whether the policy was evaluated without items that users had seen.
    """
    diagnosis = diagnosis or diagnose(steps)
    reasons = [*forbidden, *_reasons(diagnosis, filter_seen)]
    if wanted_lift is None:
        wanted_lift = 0.05 * abs(float(steps.returns.mean()))
    terms: Mapping[str, Terms] = {}
    if diagnosis.left_out < diagnosis.sessions:
        known = steps.known()
        terms = session_terms(known)
    name = next((name for name in BEST_FIRST if name in terms), None)
    if name is None:
        nothing = (None,) * 5
        return Verdict(False, tuple(reasons), *nothing, wanted_lift, None, declared)
    lifts = influences(terms[name]) - known.returns
    (interval,) = cluster_intervals(lifts[:, None], np.ones((len(lifts), 1)), known.user, seed)
    if interval is None:
        reasons.append("the sessions do not differ enough for an interval")
    return Verdict(
        reliable=not reasons,
        reasons=tuple(reasons),
        estimator=name,
        lift=float(lifts.mean()),
        lift_low=None if interval is None else interval.low,
        lift_high=None if interval is None else interval.high,
        probability_better=None if interval is None else interval.above_zero,
        wanted_lift=wanted_lift,
        sessions_needed=_sessions_needed(interval, wanted_lift, len(lifts)),
        declared=declared,
    )


def influences(terms: Terms) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """(S,) whose mean is the estimate, and whose spread is its error to first order."""
    value = terms.above.sum() / terms.below.sum()
    return np.asarray(value + (terms.above - value * terms.below) / terms.below.mean())


def cautions(diagnosis: Diagnosis, found: Mapping[str, Estimate]) -> list[str]:
    """What to know of an estimate that may stand all the same."""
    said = []
    if diagnosis.left_out and diagnosis.left_out < diagnosis.sessions:
        said.append(
            f"{diagnosis.left_out:,} of {diagnosis.sessions:,} sessions have a step without "
            "propensity: estimates that weigh leave these sessions out"
        )
    stops = diagnosis.unsupported_from_step
    if stops is not None:
        said.append(
            f"from step {stops} on fewer than {ENOUGH_USERS} effective users are left: the logs "
            "do not support an estimate there"
        )
    if "DM" in found:
        said.append("DM and FQE are only as good as their models: they carry no interval")
    if "MIPS" in found:
        said.append(
            "MIPS is right only if the reward of an item depends on its group alone: no interval"
        )
    return said


def _reasons(diagnosis: Diagnosis, filter_seen: bool) -> list[str]:
    """What forbids a conclusion, the gravest first."""
    if diagnosis.overlap is None:
        return ["no session has all its propensities, so nothing can be weighed"]
    said = []
    if diagnosis.left_out > MOST_LEFT_OUT * diagnosis.sessions:
        said.append(
            f"{diagnosis.left_out / diagnosis.sessions:.0%} of the sessions have a step without "
            f"propensity (above {MOST_LEFT_OUT:.0%}), and may differ from the rest"
        )
    failed, mean = _failed_tests(diagnosis, filter_seen), diagnosis.mean_weight
    said += failed
    if not failed and mean is not None and abs(mean - 1) > FAR_OFF:
        said.append(
            f"the mean session weight is {mean:.2f} where 1 is expected: at random, sessions that "
            f"the policy would often have are too {'rare' if mean < 1 else 'many'}; give more logs"
        )
    if not diagnosis.rewarded_users:
        said.append("no session has both weight and reward: the logs support no estimate")
    elif diagnosis.rewarded_users < ENOUGH_REWARDED:
        said.append(
            f"only {diagnosis.rewarded_users} users have both weight and reward (below "
            f"{ENOUGH_REWARDED})"
        )
    if diagnosis.effective_users < ENOUGH_USERS:
        said.append(
            f"the weights leave {diagnosis.effective_users:,.0f} effective of {diagnosis.users:,} "
            f"users (below {ENOUGH_USERS})"
        )
    if diagnosis.largest_weight > DOMINANT:
        said.append(f"one user has {diagnosis.largest_weight:.0%} of all weight")
    if diagnosis.tail is not None and diagnosis.tail > HEAVY_TAIL:
        said.append(
            f"the weights have too heavy a tail (Pareto k {diagnosis.tail:.2f}, above {HEAVY_TAIL})"
        )
    return said


def _failed_tests(diagnosis: Diagnosis, filter_seen: bool) -> list[str]:
    failed = [test for test in diagnosis.tests if not test.passed]
    if not failed:
        return []
    # The products show the size of the error; else the test that is furthest off.
    worst = next((t for t in failed if t.name == SESSION_PRODUCTS), None) or max(
        failed, key=lambda test: abs(math.log(max(test.mean, 1e-12)))
    )
    alone = failed == [worst] and worst.name == SESSION_PRODUCTS
    if worst.mean < 1 and alone and _few_weigh(diagnosis):
        cause = (
            "sessions that the policy would often have may be too rare in these logs: give more "
            "logs; or the logs lack choices that the policy makes"
        )
    elif worst.mean < 1:
        lacks = OTHERS_REMOVED if filter_seen else _SEEN_REMOVED
        cause = (
            f"the logs lack choices that the policy makes ({lacks}), or propensities are too large"
        )
    else:
        cause = "propensities are too small"
    said = f"{worst}, where 1 is expected: {cause}"
    if worst.mean < 1 and diagnosis.bounds is not None:
        low, high = diagnosis.bounds
        said += f" (if they are right, the value lies between {low:.4g} and {high:.4g})"
    return [said]


def _few_weigh(diagnosis: Diagnosis) -> bool:
    """Whether the tests of weights, which take means for normal, reject too often: few users have
    most of the weight."""
    heavy = diagnosis.tail is not None and diagnosis.tail > HEAVY_TAIL
    return heavy or diagnosis.effective_users < ENOUGH_USERS


def _sessions_needed(interval: Interval | None, lift: float, sessions: int) -> int | None:
    if interval is None or lift <= 0:
        return None
    return math.ceil(sessions * (_DETECTED * interval.error / lift) ** 2)
