"""Measures that a launch must not harm, and differences of groups, with intervals held at once."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

from ucfrec.arrays import Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.off_policy.estimators import simultaneous_intervals
from ucfrec.off_policy.verdict import diagnose_weights, list_reasons
from ucfrec.results.evidence import UNMEASURED, Evidence

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
            raise InputError(f"--guardrail {text!r}: write e.g. 'dwell_seconds >= -2%'")
        return cls(match[1], match[2] == ">=", float(match[3]) / 100)

    @property
    def outcome(self) -> str:
        """Whether it holds, is broken, or open."""
        sign, ends = (1, (self.change.low, self.change.high))
        if not self.at_least:
            sign, ends = -1, ends[::-1]
        low, high = (None if end is None else sign * (end - self.bound) for end in ends)
        return _OUTCOMES.get(Evidence(None, low, high, self.change.reasons).standing(), "open")

    def __str__(self) -> str:
        side = "at least" if self.at_least else "at most"
        why = f" ({self.change.reasons[0]})" if self.change.reasons else ""
        change = f"{self.change.format('+.1%')}, {side} {self.bound:+.1%}"
        return f"guardrail {self.measure}: {change}: {self.outcome}{why}"


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


def compare_groups(
    names: Sequence[str],
    above: Float64Array,
    below: Float64Array,
    weights: Float64Array,
    user: IntArray,
    seed: int,
) -> list[GroupDifference]:
    """The differences Σ above / Σ below (S, K) of sessions in K groups; those of groups whose
    weights (S,) stand have intervals that hold at once."""
    groups, reliable = list[GroupDifference](), list[int]()
    for number, name in enumerate(names):
        inside = below[:, number] > 0
        diagnosis = diagnose_weights(weights[inside], above[inside, number], user[inside])
        reasons = tuple(list_reasons(diagnosis))
        value = float(above[:, number].sum() / below[:, number].sum())
        groups.append(GroupDifference(name, diagnosis.users, Evidence(value, None, None, reasons)))
        if not reasons:
            reliable.append(number)
    if reliable:
        ends = simultaneous_intervals(above[:, reliable], below[:, reliable], user, seed)
        for number, (value, low, high) in zip(reliable, ends, strict=True):
            groups[number] = replace(groups[number], difference=Evidence(value, low, high))
    return groups
