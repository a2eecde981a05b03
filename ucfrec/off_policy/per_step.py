"""The value of a policy per step, from logs of which only some steps have propensities.

The contextual bandit of Dudík, Langford & Li (ICML 2011) on those steps: the mean reward of a step,
had the evaluated policy chosen its item after a history as the logging policy makes them. It says
nothing of the histories that the policy itself would make, and so nothing of a session's return.
The steps have to be picked at random, as where a share of the requests is randomised.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.off_policy.estimators import LOGGED, Estimate, Terms, summaries
from ucfrec.off_policy.intervals import cluster_means
from ucfrec.off_policy.logged_steps import LoggedSteps

BEST: Final = "DR"
"""The estimate that the lift is of."""
_ERRORS: Final = 3.0
"""Standard errors by which the mean weight may differ from 1."""


@dataclass(frozen=True)
class StepValue:
    """What N' logged steps with a propensity say of the evaluated policy, per step."""

    estimates: dict[str, Estimate]
    """Mean reward of a step as logged, and by IPS, SNIPS and DR under the evaluated policy."""
    lift: Estimate
    """Of DR over the steps as logged."""
    steps: int
    """N'."""
    of: int
    """All logged steps."""
    mean_weight: float
    """Mean of target / propensity; 1 is expected."""
    mean_weight_error: float
    """Its standard error, over users."""

    @property
    def doubt(self) -> str | None:
        """Why not to believe the estimates; None if nothing is found."""
        if abs(self.mean_weight - 1) <= _ERRORS * self.mean_weight_error:
            return None
        return (
            f"per step, the mean weight is {self.mean_weight:.3g} ± {self.mean_weight_error:.2g} "
            "where 1 is expected: propensities are wrong, or those steps lack choices that the "
            "policy makes"
        )

    def __str__(self) -> str:
        interval = ""
        if self.lift.low is not None and self.lift.high is not None:
            interval = f" [{self.lift.low:+.4g}, {self.lift.high:+.4g}]"
        return (
            f"per step, on the {self.steps:,} of {self.of:,} steps with a propensity, under the "
            f"logging policy's distribution of histories: {self.lift.value:+.4g}{interval} a step "
            f"by {BEST}; no estimate of a session's return"
        )


def step_value(steps: LoggedSteps, seed: int) -> StepValue | None:
    """Estimate the value per step; None where all steps have propensities, too few, or no weight.

    Args:
        steps: with models of the reward.
        seed: draws the bootstrap's resamples.
    """
    known = ~np.isnan(steps.propensity)
    if steps.model is None or known.all() or known.sum() < 2:
        return None
    reward, weight, terms = _terms(steps, known)
    if not weight.any():
        return None
    ones, user = np.ones(len(reward)), steps.users[steps.session[known]]
    lifts = Terms(terms[BEST].above - reward, ones, weight)
    found = summaries({LOGGED: Terms(reward, ones, ones), **terms, "lift": lifts}, user, seed)
    (mean,), (error,) = cluster_means(weight[:, None], user)
    return StepValue(
        lift=found.pop("lift"),
        estimates=found,
        steps=len(reward),
        of=len(known),
        mean_weight=float(mean),
        mean_weight_error=float(error),
    )


def _terms(
    steps: LoggedSteps, known: BoolArray
) -> tuple[Float64Array, Float64Array, dict[str, Terms]]:
    """Rewards and weights (N',) of the steps that are known, and the terms of the estimates."""
    assert steps.model is not None
    rows: IntArray = np.flatnonzero(known)
    reward, ones = steps.reward[rows], np.ones(len(rows))
    weight = steps.target[rows] / steps.propensity[rows]
    left = reward - steps.model.logged_reward[rows]
    doubly = steps.model.reward[rows] + weight * left
    return (
        reward,
        weight,
        {
            "IPS": Terms(weight * reward, ones, weight),
            "SNIPS": Terms(weight * reward, weight, weight),
            BEST: Terms(doubly, ones, weight),
        },
    )
