"""Several runs, target returns and rules, judged by the same logs and ranked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ucfrec.errors import InputError
from ucfrec.off_policy.evaluate import OffPolicyReport
from ucfrec.off_policy.selection import Selection, select

_FEWEST_DIGITS: Final = 6
_MOST_DIGITS: Final = 17
"""As many tell any two floats apart."""


@dataclass(frozen=True)
class Choice:
    """What the logs say of several candidates together."""

    selection: Selection | None
    """The candidates whose verdicts stand, ranked; None if there are none."""
    excluded: Mapping[str, str]
    """Name of each other candidate, and what forbids a conclusion."""

    @property
    def headline(self) -> str:
        """Which candidate to take, or that the logs do not tell."""
        if self.selection is None:
            return "The logs allow no conclusion on any of the candidates"
        return self.selection.headline

    def columns(self, name: str) -> dict[str, Any]:
        """What the rows of a candidate record of it."""
        found: dict[str, Any] = {"selection": self.headline}
        if self.selection is None:
            return found
        for one in self.selection.standings:
            if one.name == name:
                found |= {
                    "band_low": one.low,
                    "band_high": one.high,
                    "probability_best": one.probability_best,
                    "rank": one.rank,
                    "candidates": len(self.selection.standings),
                }
                if one.rank == 1:
                    found |= {
                        "corrected": self.selection.corrected,
                        "regret": self.selection.regret,
                    }
        return found


def choose(reports: Mapping[str, OffPolicyReport], seed: int) -> Choice:
    """Rank the candidates whose verdicts stand.

    Args:
        reports: of each candidate by name, all made from the same logs.
        seed: draws the bootstrap's resamples.

    Raises:
        InputError: the candidates' runs read the logs as different sessions or rewards.
    """
    _require_same_sessions(reports)
    standing = {name: one for name, one in reports.items() if one.verdict.reliable}
    excluded = {
        name: "; ".join(one.verdict.reasons)
        for name, one in reports.items()
        if not one.verdict.reliable
    }
    terms = {name: one.terms for name, one in standing.items() if one.terms is not None}
    if not terms:
        return Choice(None, excluded)
    user = next(iter(standing.values())).user
    columns = np.stack(list(terms.values()), axis=1)
    return Choice(select(list(terms), columns, seed, user), excluded)


def _require_same_sessions(reports: Mapping[str, OffPolicyReport]) -> None:
    (first, one), *others = reports.items()
    for name, other in others:
        if len(other.returns) != len(one.returns) or not np.allclose(other.returns, one.returns):
            raise InputError(
                f"{first} and {name} read these logs as different sessions or rewards (their "
                "stores were prepared in different ways), so their estimates cannot be compared; "
                "judge them one at a time"
            )


def names_of(candidates: Sequence[Mapping[str, object]]) -> list[str]:
    """Names that say what differs among the candidates, e.g. "target return 5, greedy".

    Candidates that differ have different names: numbers have the digits that tell them apart.

    Args:
        candidates: of each, what it is made of, e.g. run, target return and rule.
    """
    differing = [
        key for key in candidates[0] if len({str(one[key]) for one in candidates}) > 1
    ] or list(candidates[0])[:1]
    columns = [_parts(key, [one[key] for one in candidates]) for key in differing]
    return [", ".join(parts) for parts in zip(*columns, strict=True)]


def _parts(key: str, values: Sequence[object]) -> list[str]:
    """What the names say of one part of all candidates."""
    parts: list[str] = []
    for digits in range(_FEWEST_DIGITS, _MOST_DIGITS + 1):
        parts = [_part(key, value, digits) for value in values]
        if len(set(parts)) == len(set(values)):
            break
    return parts


def _part(key: str, value: object, digits: int) -> str:
    if value is None:
        return f"largest {key} expected"
    return f"{key} {value:.{digits}g}" if isinstance(value, float) else str(value)
