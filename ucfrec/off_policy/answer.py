"""Whether to launch a policy: the answer first, then the evidence that it rests on."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from ucfrec.off_policy.estimators import (
    NO_INTERVAL,
    NO_SPREAD,
    Interval,
    cluster_intervals,
    cluster_mean,
    session_terms,
)
from ucfrec.off_policy.guardrails import GroupDifference, Guardrail
from ucfrec.off_policy.logged_steps import LoggedSteps, Modelled
from ucfrec.off_policy.verdict import (
    DOMINANT,
    ENOUGH_USERS,
    HEAVY_TAIL,
    Diagnosis,
    diagnose,
    list_reasons,
)
from ucfrec.results.evidence import Evidence

DAY_MS = 86_400_000
Answer: TypeAlias = Literal["launch", "test it", "do not launch", "the log cannot say"]
BEST_FIRST = ("REG", "SNPDIS")
"""The estimator that a verdict is about: the first of these that there is."""
_ROUNDING = 1e-4
"""Largest lift of a session, in mean returns, that the behavior policy itself may seem to have."""
MOST_LINES = 15
"""Lines of an answer."""
_DETECTED = 1.96 + 0.84
"""Standard errors in a lift that 80% of samples would find at 95% confidence."""
_SHARES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Shares of exploration to recommend."""
_MOST_DAYS = 28
"""Longest exploration that is recommended, if a larger share is quicker."""


@dataclass(frozen=True)
class Traffic:
    """How the logs came about, as far as plans for more of them need it."""

    days: float
    """From the first session to the last."""
    users: int
    steps: int
    draws: float
    """E[w²] of uniform draws from the catalogue, whose weights w have mean 1."""

    def plan_more(self, diagnosis: Diagnosis) -> str:
        """For how many days to log as now, where no more than that is lacking."""
        effective, passed = diagnosis.effective_users, all(test.passed for test in diagnosis.tests)
        heavy = (diagnosis.tail or 0.0) > HEAVY_TAIL or diagnosis.largest_weight > DOMINANT
        if not self.days or heavy or not passed or not 0 < effective < ENOUGH_USERS:
            return ""
        return f"log {_format_days(1.2 * self.days * ENOUGH_USERS / effective)} of such traffic"

    def plan_exploration(self) -> str:
        """The share of random items, and for how many days, that lets each step be evaluated."""
        if not self.days:
            return ""
        for share in _SHARES:
            # Sums of n weights of a user have a variance of (E[w²] − 1) / n, in units of the mean.
            spread = (self.draws / share - 1) * self.users / self.steps
            wait = self.days * ENOUGH_USERS * (1 + spread) / self.users
            if wait <= _MOST_DAYS:
                break
        return (
            f"serve with --explore {share:g} for {_format_days(wait)} of such traffic, after which "
            "each step can be evaluated"
        )


@dataclass(frozen=True)
class ABTest:
    """The plan of a test on half of the users each."""

    lift: float
    """Per session, which it finds in four of five tests."""
    users: int
    days: float | None

    def __str__(self) -> str:
        time = "" if self.days is None else f" over {_format_days(self.days)} of such traffic"
        return (
            f"plan: {self.users:,} users{time}, half of them served by each policy, find a gain of "
            f"{self.lift:.3g} per session in 4 of 5 tests\n"
            "stop: at that end by the interval of a planned end of ucfrec compare, or earlier as "
            "soon as its always-valid interval excludes 0"
        )


def plan_test(steps: LoggedSteps, lift: float, days: float | None) -> ABTest | None:
    """The smallest test that finds a lift in return per session in 80% of cases, if users come and
    return as in the logs; None where they do not differ, or nothing is to be found."""
    users = len(np.unique(steps.users))
    error = cluster_mean(steps.returns, steps.users)[1]
    if lift <= 0 or not 0 < error < 1e6 * lift:
        return None
    # A half of the traffic has twice the variance, and so has their difference.
    size = (2 * _DETECTED * error / lift) ** 2
    return ABTest(lift, max(2, math.ceil(users * size)), days and days * size)


def _format_days(days: float) -> str:
    whole = max(1, math.ceil(days))
    return f"{whole:,} day{'s' * (whole > 1)}"


def cut_to_steps(steps: LoggedSteps) -> LoggedSteps | None:
    """The steps with a propensity, each as a session of its own: what follows is the mean reward of
    a step (Dudík, Langford & Li, ICML 2011), had the evaluated policy chosen the item after a
    history as the logging policy makes them; not the return of its sessions. None without models,
    or where too few steps can be weighed."""
    rows = np.flatnonzero(~np.isnan(steps.propensity))
    if steps.model is None or len(rows) < 2 or not steps.target[rows].any():
        return None
    value, logged = steps.model.reward[rows], steps.model.logged_reward[rows]
    return LoggedSteps(
        np.arange(len(rows)),
        steps.reward[rows],
        steps.propensity[rows],
        steps.target[rows],
        Modelled(value, q=logged, v=value, logged_reward=logged),
        steps.users[steps.session[rows]],
    )


@dataclass(frozen=True)
class Verdict:
    """What the logs say of the evaluated policy against the behavior policy."""

    lift: Evidence
    """Of its value over the mean return as logged, on the same sessions; clustered by user."""
    estimator: str | None
    """Which estimate the lift is of; None where nothing could be weighed."""
    logged: float
    """Mean return of a session as logged."""
    effective_users: float
    wanted_lift: float
    """Return per session that a launch should gain."""
    test: ABTest | None
    declared: str = ""
    """What the estimate rests on beside the logs, e.g. estimated propensities."""
    per_step: "Verdict | None" = None
    """That on single steps (`cut_to_steps`), where this one is not reliable."""
    guardrails: Sequence[Guardrail] = ()
    groups: Sequence[GroupDifference] = ()
    remedies: Sequence[str] = ()
    """What would let the logs say more."""

    @property
    def reasons(self) -> tuple[str, ...]:
        """What forbids a conclusion on the return of sessions; empty if it is reliable."""
        return self.lift.reasons

    @property
    def answer(self) -> Answer:
        """What to do: a launch needs a gain and every guardrail, a test a chance of the lift."""
        evidence, outcomes = self.lift, {guardrail.outcome for guardrail in self.guardrails}
        if not evidence.is_reliable and self.per_step is not None:
            evidence = self.per_step.lift
        if not evidence.is_reliable or evidence.high is None:
            return "the log cannot say"
        standing, by_step = evidence.standing(), evidence is not self.lift
        if "broken" in outcomes or standing == "worse":
            return "do not launch"
        if standing == "better" and not by_step and outcomes <= {"holds"}:
            return "launch"
        hopeless = standing != "better" and evidence.high < self.wanted_lift and not by_step
        return "do not launch" if hopeless else "test it"

    @property
    def headline(self) -> str:
        """The answer, and the evidence for it, in a line."""
        says, rests_on = self.answer, f" ({self.declared})" if self.declared else ""
        if says == "the log cannot say":
            return f"{says}: {self.reasons[0]}{rests_on}"
        if not self.lift.is_reliable and (step := self.per_step) is not None:
            return f"{says}: {step.lift.format()} per step, by {step.estimator}{rests_on}"
        share = self.lift.value / abs(self.logged) if self.lift.value and self.logged else 0.0
        why = f", less than the wanted gain of {self.wanted_lift:.3g}"
        if self.lift.standing() in ("better", "worse"):
            why = "" if says != "test it" else ", but a guardrail is open"
        elif says == "test it":
            why = ", no reliable gain or loss"
        if any(guardrail.outcome == "broken" for guardrail in self.guardrails):
            why = ", but a guardrail is broken"
        return f"{says}: {self.lift.format()} per session ({share:+.1%}){why}{rests_on}"

    def list_lines(self) -> list[str]:
        """The headline, then what else it rests on, and what to do next."""
        lines, says = [self.headline], self.answer
        if not self.lift.is_reliable:
            if says == "the log cannot say":
                lines += [f"and: {reason}" for reason in self.reasons[1:3]]
                if self.per_step is not None:
                    lines.append(f"per step: – ({self.per_step.lift.reasons[0]})")
            else:
                lines.append(f"per session: – ({self.reasons[0]})")
        by = f"; by {self.estimator} on {self.effective_users:,.0f} effective users"
        logged = f"logged: {self.logged:.4g} per session"
        lines.append(logged + by * self.lift.is_reliable)
        lines += map(str, self.guardrails)
        lines += map(str, self.groups)
        if says == "test it" and self.test is not None:
            lines += str(self.test).splitlines()
        elif says == "launch":
            lines.append("next: serve it to a growing share of the users, and compare the arms")
        elif says == "do not launch":
            lines.append("next: evaluate other policies, --targets or --temperatures")
        elif self.remedies:
            lines.append(f"to find out: {'; or '.join(self.remedies)}")
        return lines

    def __str__(self) -> str:
        return "; ".join([self.headline, *self.reasons[self.answer == "the log cannot say" :]])

    def list_columns(self) -> dict[str, Any]:
        """What result rows have of it, by name."""
        columns = {
            "answer": self.answer,
            "verdict": str(self),
            "verdict_of": self.estimator,
            "reliable": self.lift.is_reliable,
            "lift": self.lift.value,
            "lift_low": self.lift.low,
            "lift_high": self.lift.high,
            "guardrails": [asdict(row) | {"outcome": row.outcome} for row in self.guardrails],
            "groups": [asdict(group) for group in self.groups],
            "test": self.test and asdict(self.test),
        }
        return columns | {"wanted_lift": self.wanted_lift, "declared": self.declared}


def conclude(
    steps: LoggedSteps,
    seed: int,
    diagnosis: Diagnosis | None = None,
    wanted_lift: float | None = None,
    forbidden: Sequence[str] = (),
    declared: str = "",
    days: float | None = None,
) -> Verdict:
    """Compare the evaluated policy with the behavior policy, if the logs allow it, and nothing is
    `forbidden`. A launch should gain `wanted_lift` per session, by default 5% of the mean logged
    return. `days` are those from the first session to the last."""
    diagnosis = diagnosis or diagnose(steps)
    reasons = [*forbidden, *list_reasons(diagnosis)]
    if wanted_lift is None:
        wanted_lift = 0.05 * abs(float(steps.returns.mean()))
    terms = {} if steps.lacking.all() else session_terms(steps.weighable)
    name = next((name for name in BEST_FIRST if name in terms), None)
    value = interval = None
    if name is not None:
        returns = steps.weighable.returns
        lifts = terms[name].influences - returns
        value, ones = float(lifts.mean()), np.ones((len(lifts), 1))
        (interval,) = cluster_intervals(lifts[:, None], ones, steps.weighable.user, seed)
        if np.allclose(lifts, 0.0, atol=_ROUNDING * np.abs(returns).mean()):
            value, interval = 0.0, Interval(0.0, 0.0, 0.0)
        elif interval is None:
            reasons += NO_SPREAD.reasons
    low, high, _ = interval or NO_INTERVAL
    return Verdict(
        lift=Evidence(value, low, high, tuple(reasons)),
        estimator=name,
        logged=float(steps.returns.mean()),
        effective_users=diagnosis.effective_users,
        wanted_lift=wanted_lift,
        test=plan_test(steps, wanted_lift, days),
        declared=declared,
    )
