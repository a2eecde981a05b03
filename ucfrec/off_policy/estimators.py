"""What a policy would have earned a session, from logs of another: arrays in, estimates out."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ucfrec.errors import InputError
from ucfrec.evaluation.metrics import ratio_intervals
from ucfrec.off_policy.fqe import Modelled

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LOGGED = "logged"
WEIGHTED = ("IPS", "SNIPS", "PDIS", "DR")
ENOUGH_SESSIONS, ENOUGH_OVERLAP, DOMINANT = 1000, 0.8, 0.1
_LARGEST = 1e100
"""Weights stop here: beyond, an estimate means nothing, and their squares stay finite."""


@dataclass(frozen=True)
class LoggedSteps:
    """N logged steps of S sessions, a session's steps together and in order.

    Raises:
        InputError: lengths differ, sessions are not numbered in order, a number is not finite, a
            probability is none.
    """

    session: IntArray
    """(N,) number of each step's session: 0 to S − 1, never falling, none left out."""
    reward: FloatArray
    propensity: FloatArray
    """(N,) the behavior policy's probability of the logged action; NaN where unknown."""
    target: FloatArray
    """(N,) the judged policy's probability of it."""
    model: Modelled | None = None

    def __post_init__(self) -> None:
        n = len(self.session)
        finite = {"reward": self.reward, "target": self.target}
        if self.model is not None:
            finite |= {f"modelled {name}": values for name, values in vars(self.model).items()}
        for name, values in {**finite, "propensity": self.propensity}.items():
            if values.shape != (n,):
                raise InputError(f"{name} has shape {values.shape}, {n} steps are ({n},)")
        for name, values in finite.items():
            if not np.isfinite(values).all():
                raise InputError(f"{name} is not finite at {(~np.isfinite(values)).sum()} steps")
        rises = np.diff(self.session, prepend=-1)
        if n == 0 or rises[0] != 1 or not np.isin(rises, (0, 1)).all():
            raise InputError("sessions are numbered from 0 in order, and there is at least one")
        if not ((self.target >= 0) & (self.target <= 1)).all():
            raise InputError("probabilities of the judged policy lie between 0 and 1")
        if not (np.isnan(self.propensity) | (self.propensity > 0) & (self.propensity <= 1)).all():
            raise InputError(
                "propensities must be above 0 and at most 1 (a probability, not a density); "
                "correct that column"
            )

    @cached_property
    def first(self) -> IntArray:
        """(S,) step that begins each session."""
        return np.flatnonzero(np.diff(self.session, prepend=-1))

    @property
    def unknown_propensities(self) -> int:
        """How many steps have none."""
        return int(np.isnan(self.propensity).sum())

    def per_session(self, values: FloatArray) -> FloatArray:
        """(S,) sums of values (N,)."""
        return np.asarray(np.add.reduceat(values, self.first))


@dataclass(frozen=True)
class Estimate:
    """Mean return of a session, with its 95% percentile bootstrap interval over sessions."""

    value: float
    low: float
    high: float
    effective_sessions: float
    """(Σw)² / Σw² of the sessions' weights (Kish 1965); S where nothing is weighted."""
    largest_weight: float
    """Share of the heaviest session in all weight."""


def estimate(steps: LoggedSteps, seed: int) -> dict[str, Estimate]:
    """What sessions earned as logged, and what they would have earned.

    Of `model`, where given: DM is the modelled reward of the judged policy, summed over a session's
    logged steps (states and length stay as logged); FQE is v at its first step. With propensities
    at every step: IPS weights a session's return by the product of its ratios, PDIS each reward by
    the product up to its step (Precup 2000); SNIPS divides IPS by the mean weight of sessions
    (Swaminathan & Joachims 2015); DR adds the weighted errors of q to v (Dudík 2011, over sessions
    Jiang & Li 2016). Where no session has any weight, these four are left out.
    """
    ones = np.ones(len(steps.first))
    returns = steps.per_session(steps.reward)
    # Each is a ratio of sums over sessions: above, below, and the weights of sessions.
    sums = {LOGGED: (returns, ones, ones)}
    if steps.model is not None:
        sums["DM"] = (steps.per_session(steps.model.reward), ones, ones)
        sums["FQE"] = (steps.model.v[steps.first], ones, ones)
    if not steps.unknown_propensities:
        sums |= _weighted(steps, returns, ones)
    above, below, _ = (np.stack(columns, axis=1) for columns in zip(*sums.values(), strict=True))
    intervals = ratio_intervals(above, below, seed)
    return {
        name: Estimate(
            value=float(over.sum() / under.sum()),
            low=float(low),
            high=float(high),
            effective_sessions=float(weights.sum() ** 2 / (weights**2).sum()),
            largest_weight=float(weights.max() / weights.sum()),
        )
        for (name, (over, under, weights)), (low, high) in zip(sums.items(), intervals, strict=True)
    }


def _weighted(
    steps: LoggedSteps, returns: FloatArray, ones: FloatArray
) -> dict[str, tuple[FloatArray, FloatArray, FloatArray]]:
    upto = cumulative_ratios(steps)
    weights = upto[np.append(steps.first[1:], len(upto)) - 1]
    if not weights.any():
        return {}
    found = {
        "IPS": (weights * returns, ones, weights),
        "SNIPS": (weights * returns, weights, weights),
        "PDIS": (steps.per_session(upto * steps.reward), ones, weights),
    }
    if steps.model is not None:
        before = np.roll(upto, 1)
        before[steps.first] = 1.0
        corrected = upto * (steps.reward - steps.model.q) + before * steps.model.v
        found["DR"] = (steps.per_session(corrected), ones, weights)
    return found


def cumulative_ratios(steps: LoggedSteps) -> FloatArray:
    """(N,) product of target / propensity from the session's first step to each."""
    upto = steps.target / steps.propensity
    lengths = np.diff(np.append(steps.first, len(upto)))
    # One pass a place in the session: sums of logarithms would lose digits over many sessions.
    longest_first = np.argsort(-lengths, kind="stable")
    starts, lengths = steps.first[longest_first], lengths[longest_first]
    for place in range(1, int(lengths[0])):
        at = starts[: np.searchsorted(-lengths, -place, side="left")] + place
        upto[at] = np.minimum(upto[at] * upto[at - 1], _LARGEST)
    return np.asarray(np.minimum(upto, _LARGEST))


def overlap(steps: LoggedSteps) -> float:
    """Mean ratio target / propensity of steps: an estimate of the share of the judged policy's
    choices that the behavior policy could make too. Near 1 where it could make all; NaN without
    propensities."""
    return float((steps.target / steps.propensity).mean())


def warnings(steps: LoggedSteps, found: Mapping[str, Estimate]) -> list[str]:
    """Why not to believe `found`, a line a reason."""
    weighted, sessions = ", ".join(WEIGHTED), len(steps.first)
    if steps.unknown_propensities:
        return [
            f"{steps.unknown_propensities:,} of {len(steps.reward):,} steps have no propensity: "
            f"no {weighted}; DM and FQE are only as good as their models"
        ]
    said = []
    shared = overlap(steps)
    if shared < ENOUGH_OVERLAP:
        said.append(
            f"overlap {shared:.2f} (below {ENOUGH_OVERLAP}): the logs lack much of what the policy "
            "would show"
        )
    if "IPS" not in found:
        said.append(
            f"no session has any weight: in each of {sessions:,} the policy would never have made "
            f"some logged choice; no {weighted}"
        )
        return said
    weights = found["IPS"]
    if weights.effective_sessions < ENOUGH_SESSIONS:
        said.append(
            f"effective sample {weights.effective_sessions:,.0f} of {sessions:,} sessions (below "
            f"{ENOUGH_SESSIONS:,}): {weighted} and their intervals are not to be relied on"
        )
    if weights.largest_weight > DOMINANT:
        said.append(
            f"one session has {weights.largest_weight:.0%} of all weight: {weighted} tell of it "
            "more than of the rest"
        )
    return said


def as_row(name: str, found: Estimate) -> dict[str, Any]:
    """An estimate as a result row; the mean return is R_cum, as in `ucfrec.evaluation.metrics`."""
    return {
        "estimator": name,
        "R_cum": found.value,
        "R_cum_low": found.low,
        "R_cum_high": found.high,
        "effective_sessions": found.effective_sessions,
        "largest_weight": found.largest_weight,
    }
