"""Measures that a launch must not harm, and differences of groups, with intervals held at once."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ucfrec.arrays import Float64Array, IntArray
from ucfrec.off_policy.estimators import (
    NO_INTERVAL,
    NO_SPREAD,
    cluster_intervals,
    normalise_by_step,
    simultaneous_intervals,
)
from ucfrec.off_policy.logged_steps import LoggedSteps, merge_lists
from ucfrec.off_policy.verdict import diagnose, list_reasons
from ucfrec.results.evidence import UNMEASURED, Evidence
from ucfrec.settings import SettingError

_WRITTEN = re.compile(r"\s*(\S.*?)\s*(>=|<=)\s*([+-]?\d+(?:\.\d+)?)\s*%\s*")
_OUTCOMES = {"better": "holds", "worse": "broken"}


@dataclass(frozen=True)
class Guardrail:
    """A bound for the change of a measure, as a share of what it was before."""

    measure: str
    """SQL expression over the columns of the log."""
    at_least: bool
    """Whether the bound is the least change, or the most."""
    bound: float
    change: Evidence = UNMEASURED

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `dwell_seconds >= -2%`; InputError if it is not written so."""
        match = _WRITTEN.fullmatch(text)
        if match is None:
            raise SettingError(f"guardrail {text!r}: write e.g. 'dwell_seconds >= -2%'")
        return cls(match[1], match[2] == ">=", float(match[3]) / 100)

    @property
    def outcome(self) -> str:
        """Whether it holds, is broken, or open."""
        sign = 1 if self.at_least else -1
        ends = (self.change.low, self.change.high)[::sign]
        low, high = (None if end is None else sign * (end - self.bound) for end in ends)
        return _OUTCOMES.get(Evidence(None, low, high, self.change.reasons).standing(), "open")

    def __str__(self) -> str:
        side = "at least" if self.at_least else "at most"
        why = f" ({self.change.reasons[0]})" if self.change.reasons else ""
        change = f"{self.change.format('+.1%')}, {side} {self.bound:+.1%}"
        return f"guardrail {self.measure}: {change}: {self.outcome}{why}"


@dataclass(frozen=True)
class Groups:
    """Groups of the users, or of the items, of N logged steps."""

    names: tuple[str, ...]
    number: IntArray
    """(N,) group of each step, a place in `names`, or −1."""
    of_items: bool


@dataclass(frozen=True)
class GroupDifference:
    """The difference in one group of users or items."""

    name: str
    users: int
    difference: Evidence
    """Its interval is one of those that hold for all groups at once."""

    def __str__(self) -> str:
        why = f" ({self.difference.reasons[0]})" if self.difference.reasons else ""
        return f"{self.name} ({self.users:,} users): {self.difference.format()}{why}"


def _weigh(steps: LoggedSteps, rewards: Float64Array) -> LoggedSteps:
    """The sessions that can be weighed, with other rewards (N,); whole lists merged."""
    steps = replace(steps, reward=rewards, model=None)
    return (merge_lists(steps) if steps.positions == "whole list" else steps).weighable


def check_guardrail(
    text: str, values: Float64Array, steps: LoggedSteps, reasons: Sequence[str], seed: int
) -> Guardrail:
    """What weights show of a measure with values (N,), by SNPDIS; nothing if `reasons` speak
    against them, or too few users have the measure."""
    guardrail, ends, value = Guardrail.parse(text), None, None
    if not reasons:
        measured = _weigh(steps, values)
        reasons = list_reasons(diagnose(measured))
    if not reasons:
        logged = measured.returns
        changes = normalise_by_step(measured, measured.reward) - logged
        if logged.sum() <= 0:
            reasons = ["its mean is not above 0"]
        else:
            value = float(changes.sum() / logged.sum())
            (ends,) = cluster_intervals(changes[:, None], logged[:, None], measured.user, seed)
            reasons = () if ends else NO_SPREAD.reasons
    low, high, _ = ends or NO_INTERVAL
    return replace(guardrail, change=Evidence(value, low, high, tuple(reasons)))


def compare_groups(
    groups: Groups, steps: LoggedSteps, lifts: Float64Array, seed: int
) -> list[GroupDifference]:
    """The lifts (S,) of sessions with weights by group of users; or, by SNPDIS, by the group of
    items that returns come from. Intervals of groups whose weights stand hold at once."""
    differences, weighable = list[GroupDifference](), _weigh(steps, steps.reward)
    terms = dict[int, Float64Array]()
    for number, name in enumerate(groups.names):
        if groups.of_items:
            rewards = np.where(groups.number == number, steps.reward, 0.0)
            part = _weigh(steps, rewards)
            inside = np.ones(len(lifts), dtype=bool)
            above = normalise_by_step(part, part.reward) - part.returns
        else:
            inside = groups.number[steps.first][~steps.lacking] == number
            above = lifts * inside
            part = weighable.select(inside) if inside.any() else weighable
        reasons = [] if inside.any() else ["no session can be weighed"]
        reasons += list_reasons(diagnose(part))
        users = len(np.unique(weighable.users[inside]))
        differences.append(GroupDifference(name, users, Evidence(None, None, None, tuple(reasons))))
        if not reasons:
            terms[number] = np.stack([above, inside])
    if terms:
        aboves, belows = np.stack([*terms.values()], axis=2)
        ends = simultaneous_intervals(aboves, belows, weighable.user, seed)
        for number, evidence in zip(terms, ends, strict=True):
            differences[number] = replace(differences[number], difference=evidence)
    return differences
