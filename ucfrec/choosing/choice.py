"""The decision rule that was chosen, and why."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from ucfrec.acting.decision import DecisionRule
from ucfrec.choosing.logged import Evidence


@dataclass(frozen=True)
class SimulatedRule:
    """A rule and what it did in sessions simulated in the user model."""

    rule: DecisionRule
    value: float
    """Mean return of a session, in reward units."""
    error: float
    """Its standard error over the sessions."""
    length: float
    """Mean number of steps of a session."""
    support: float
    """Share of decisions on items that the log supports."""
    items: float
    """Effective number of items shown."""
    evidence: Evidence | None = None
    """What validation sessions show of it; None if no one looked."""

    @property
    def effective_users(self) -> float:
        """Of `evidence`; 0 without."""
        return self.evidence.effective_users or 0.0 if self.evidence else 0.0


@dataclass(frozen=True)
class ValueEstimate:
    """Return of a session under the chosen rule, in simulated sessions that did not choose it."""

    value: float
    error: float
    """Its standard error, over the sessions or between the halves, whichever is larger."""
    halves: tuple[float, float]
    """The value in the sessions of either half of the users."""
    optimism: tuple[float, float] | None
    """By what share the user model expects too much on validation rows of users that it is not
    calibrated on, and the standard error; None where validation users are new."""
    doubts: tuple[str, ...]
    """Why it cannot be trusted; empty if it can."""


@dataclass(frozen=True)
class RankedRule:
    """A rule and how it ranks validation rows."""

    rule: DecisionRule
    item_rate: float
    """Mean share of liked impressions, in the validation period, of the items shown."""
    hits: float
    """Share of liked validation rows whose item is among those shown."""
    gain: float
    """Difference of `hits` from that of the most liked training items."""
    gain_error: float
    """Its standard error over rows."""


@dataclass(frozen=True)
class RuleChoice:
    """The rule that was chosen, and all candidates."""

    rule: DecisionRule
    chosen_by: str
    """What chose it, in words."""
    candidates: Sequence[SimulatedRule | RankedRule]
    estimate: ValueEstimate | None = None
    """Its value; None for a rule that was not simulated."""
    warning: str = ""
    """What is wrong with the rule, in words; empty if nothing is."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """What else the choice rests on, as a JSON object."""

    def as_dict(self) -> dict[str, Any]:
        """As a JSON object; `details` are entries like the others."""
        values = asdict(self)
        details: dict[str, Any] = values.pop("details")
        return {**values, **details, "candidates": [*values["candidates"]]}
