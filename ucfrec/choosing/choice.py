"""The decision rule that was chosen, and why."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from ucfrec.acting.decision import DecisionRule


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
    warning: str = ""
    """What is wrong with the rule, in words; empty if nothing is."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """What else the choice rests on, as a JSON object."""

    def as_dict(self) -> dict[str, Any]:
        """As a JSON object; `details` are entries like the others."""
        values = asdict(self)
        details: dict[str, Any] = values.pop("details")
        return {**values, **details, "candidates": [*values["candidates"]]}
