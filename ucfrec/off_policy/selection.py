"""Choosing among several policies, target returns or rules by estimates from the same logs.

The largest of several estimates is too large: what was chosen was also lucky. Hence three things
are computed together, from one bootstrap that draws users and treats all candidates alike:

- a band that holds the values of all candidates with 95% probability (max-t: Romano & Wolf,
  Econometrica 2005);
- the probability of being best, the share of resamples in which a candidate is first;
- the value of the chosen one without its luck: what the first of a resample loses, on average,
  when it is valued by the whole sample (Efron & Tibshirani 1993, chapter 10).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ucfrec.arrays import Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.off_policy.estimators import find_critical, resample

if TYPE_CHECKING:
    from ucfrec.off_policy.evaluate import OffPolicyReport


@dataclass(frozen=True)
class Standing:
    """One candidate among the others."""

    name: str
    value: float
    error: float
    """Standard error over users."""
    low: float
    """Ends of the simultaneous 95% band."""
    high: float
    probability_best: float
    """Share of resamples in which no other candidate has a larger value."""
    rank: int
    """From 1."""


@dataclass(frozen=True)
class Selection:
    """The candidates in order of their values, and what choosing the first costs."""

    standings: tuple[Standing, ...]
    """Empty if no verdict stands; then the numbers are NaN."""
    corrected: float
    """Value of the first without the luck of having been chosen."""
    regret: float
    """With 95% confidence the first is at most this far below the best of them (Hsu, Annals of
    Statistics 1984, with the clustered bootstrap)."""
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Name of each candidate that is not ranked, and what forbids a conclusion on it."""

    @property
    def headline(self) -> str:
        """What was chosen, and how certain that is."""
        if not self.standings:
            return "The logs allow no conclusion on any of the candidates"
        first = self.standings[0]
        candidate = "candidate" + " that these logs can evaluate" * bool(self.excluded)
        if len(self.standings) == 1:
            return f"{first.name} is the only {candidate}"
        value = f"{self.corrected:.4g} per session"
        sure = f"best with probability {first.probability_best:.2f}"
        if self.regret == 0:
            return f"No other {candidate} has a higher value than {first.name}: {value}, {sure}"
        return (
            f"{first.name} is the first {candidate}: {value} once corrected for the choice "
            f"({first.value:.4g} before), {sure}, at most {self.regret:.4g} below the best"
        )

    def columns(self, name: str) -> dict[str, Any]:
        """What the rows of a candidate record of it."""
        columns: dict[str, Any] = {"selection": self.headline}
        standing = next((place for place in self.standings if place.name == name), None)
        if standing is not None:
            columns |= {"band_low": standing.low, "band_high": standing.high}
            columns |= {"probability_best": standing.probability_best, "rank": standing.rank}
            columns["candidates"] = len(self.standings)
            if standing.rank == 1:
                columns |= {"corrected": self.corrected, "regret": self.regret}
        return columns


def select(
    names: Sequence[str],
    terms: Float64Array,
    seed: int,
    user: IntArray | None = None,
) -> Selection:
    """Rank K candidates by estimates on the same sessions: the means of `terms` (S, K), such as
    `influences` of REG, of sessions of `user` (S,), or of a user each (None). InputError if shapes
    differ or a number is not finite.
    """
    if terms.ndim != 2 or terms.shape[1] != len(names) or not len(names) or not len(terms):
        raise InputError(f"terms have shape {terms.shape}; give a column to each of {len(names)}")
    if not np.isfinite(terms).all():
        raise InputError(f"terms are not finite at {(~np.isfinite(terms)).sum()} places")
    resamples = resample(terms, np.ones_like(terms), user, seed)
    value, error = resamples.value, resamples.error
    half = find_critical(np.abs(resamples.studentised)) * error
    again = value + resamples.shift
    best = again == again.max(axis=1, keepdims=True)
    share = (best / best.sum(axis=1, keepdims=True)).mean(axis=0)
    standings = []
    columns = np.stack([value, error, value - half, value + half, share], axis=1).tolist()
    for rank, k in enumerate(np.argsort(-value, kind="stable"), start=1):
        worth, spread, low, high, best_share = columns[k]
        standings.append(Standing(names[k], worth, spread, low, high, best_share, rank))
    # What the first of each resample is worth there, beyond its worth in the whole sample.
    luck = resamples.shift[np.arange(len(again)), again.argmax(axis=1)].mean()
    first = int(np.argmax(value))
    corrected, regret = float(value[first] - max(luck, 0.0)), 0.0
    if len(names) > 1:
        # Upper end of how much better than the first any other may be.
        lead = np.delete(terms, first, axis=1) - terms[:, [first]]
        leads = resample(lead, np.ones_like(lead), user, seed)
        upper = leads.value + find_critical(-leads.studentised) * leads.error
        # Candidates that never differ are neither better nor worse.
        differ = np.isfinite(leads.studentised).any(axis=0)
        regret = float(upper[differ].max(initial=0.0))
    return Selection(tuple(standings), corrected, regret)


def choose(reports: "Mapping[str, OffPolicyReport]", seed: int) -> Selection:
    """Rank the candidates, by name, whose verdicts stand; InputError if their runs read the logs as
    different sessions or rewards."""
    first, *names = reports
    returns = reports[first].returns
    for name in names:
        again = reports[name].returns
        if len(again) != len(returns) or not np.allclose(again, returns):
            raise InputError(
                f"{first} and {name} read these logs as different sessions or rewards, as their "
                "stores were prepared in different ways; evaluate them one at a time"
            )
    excluded, terms = dict[str, str](), dict[str, Float64Array]()
    for name, report in reports.items():
        if report.verdict.lift.is_reliable and report.terms is not None:
            terms[name] = report.terms
        else:
            excluded[name] = "; ".join(report.verdict.reasons)
    if not terms:
        return Selection((), math.nan, math.nan, excluded)
    values = np.stack([*terms.values()], axis=1)
    ranked = select([*terms], values, seed, reports[first].user)
    return replace(ranked, excluded=excluded)


def names_of(candidates: Sequence[Mapping[str, object]]) -> list[str]:
    """Names of candidates by the parts in which they differ, e.g. "target return 5, greedy", with
    as many digits as distinguish them."""
    differing = [
        key for key in candidates[0] if len({str(parts[key]) for parts in candidates}) > 1
    ] or list(candidates[0])[:1]

    def describe(key: str, value: object, digits: int) -> str:
        return f"{key} {value:.{digits}g}" if isinstance(value, float) else str(value)

    short, full = (
        [", ".join(describe(key, parts[key], digits) for key in differing) for parts in candidates]
        for digits in (6, 17)
    )
    return short if len(set(short)) == len(short) else full
