"""Whether to believe an off-policy estimate, and what it says: computed, in plain words."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ucfrec.off_policy.diagnostics import (
    DOMINANT,
    ENOUGH_REWARDED,
    ENOUGH_USERS,
    FAR_OFF,
    HEAVY_TAIL,
    MOST_LEFT_OUT,
    SESSION_PRODUCTS,
    Diagnosis,
    diagnose,
)
from ucfrec.off_policy.estimators import session_terms
from ucfrec.off_policy.intervals import cluster_intervals
from ucfrec.off_policy.logged_steps import LoggedSteps

BEST_FIRST: Final = ("DR", "SNPDIS")
"""The estimator that a verdict is about: the first of these that there is."""
SEEN_REMOVED: Final = (
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
    reasons = [*forbidden, *_list_reasons(diagnosis, filter_seen)]
    if wanted_lift is None:
        wanted_lift = 0.05 * abs(float(steps.returns.mean()))
    terms = {} if steps.lacking.all() else session_terms(steps.weighable)
    name = next((name for name in BEST_FIRST if name in terms), None)
    if name is None:
        nothing = (None,) * 5
        return Verdict(False, tuple(reasons), *nothing, wanted_lift, None, declared)
    lifts = terms[name].influences - steps.weighable.returns
    ones, user = np.ones((len(lifts), 1)), steps.weighable.user
    (interval,) = cluster_intervals(lifts[:, None], ones, user, seed)
    if interval is None:
        reasons.append("the sessions do not differ enough for an interval")
    sessions_needed = None
    if interval is not None and wanted_lift > 0:
        sessions_needed = math.ceil(len(lifts) * (_DETECTED * interval.error / wanted_lift) ** 2)
    return Verdict(
        reliable=not reasons,
        reasons=tuple(reasons),
        estimator=name,
        lift=float(lifts.mean()),
        lift_low=None if interval is None else interval.low,
        lift_high=None if interval is None else interval.high,
        probability_better=None if interval is None else interval.above_zero,
        wanted_lift=wanted_lift,
        sessions_needed=sessions_needed,
        declared=declared,
    )


def list_cautions(diagnosis: Diagnosis, estimators: Iterable[str]) -> list[str]:
    """What to know of an estimate that may stand all the same."""
    cautions = []
    if diagnosis.left_out and diagnosis.left_out < diagnosis.sessions:
        cautions.append(
            f"{diagnosis.left_out:,} of {diagnosis.sessions:,} sessions have a step without "
            "propensity: estimates that weigh leave these sessions out"
        )
    stops = diagnosis.unsupported_from_step
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
    if any(not test.passed for test in diagnosis.tests):
        reasons.append(_explain_failure(diagnosis, filter_seen))
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


def _explain_failure(diagnosis: Diagnosis, filter_seen: bool) -> str:
    """What the worst of the failed tests shows."""
    failed = [test for test in diagnosis.tests if not test.passed]
    # The products show the size of the error; else the test that is furthest off.
    worst = next((test for test in failed if test.name == SESSION_PRODUCTS), None) or max(
        failed, key=lambda test: abs(math.log(max(test.mean, 1e-12)))
    )
    alone = len(failed) == 1 and worst.name == SESSION_PRODUCTS
    if worst.mean >= 1:
        return f"{worst}, where 1 is expected: propensities are too small"
    if alone and diagnosis.few_weigh:
        cause = (
            "sessions that the policy would often have may be too rare in these logs: give more "
            "logs; or the logs lack choices that the policy makes"
        )
    else:
        removed = OTHERS_REMOVED if filter_seen else SEEN_REMOVED
        cause = (
            f"the logs lack choices that the policy makes ({removed}), or propensities are too "
            "large"
        )
    reason = f"{worst}, where 1 is expected: {cause}"
    if diagnosis.bounds is None:
        return reason
    low, high = diagnosis.bounds
    return f"{reason} (if they are right, the value lies between {low:.4g} and {high:.4g})"
