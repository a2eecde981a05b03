"""What measurements say, and the reasons not to rely on them."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

Relation: TypeAlias = Literal["better", "worse", "level", "open"]


@dataclass(frozen=True)
class Evidence:
    """A value with its 95% interval; or the reasons why there is none to rely on."""

    value: float | None
    """None where nothing could be measured."""
    low: float | None
    """Ends of the interval; None where the sample shows none."""
    high: float | None
    reasons: tuple[str, ...] = ()
    """What speaks against relying on the value, the gravest first."""

    @property
    def interval(self) -> tuple[float, float] | None:
        """Its ends, if there is one."""
        return None if self.low is None or self.high is None else (self.low, self.high)

    @property
    def is_reliable(self) -> bool:
        """Whether there is an interval, and no reason against it."""
        return not self.reasons and self.interval is not None

    def standing(self) -> Relation:
        """What a difference shows of the first against the second: level if it is 0 throughout,
        open if it is not reliable or may be either."""
        if not self.is_reliable or self.low is None or self.high is None:
            return "open"
        if self.low > 0 or self.high < 0:
            return "better" if self.low > 0 else "worse"
        return "level" if self.low == self.high else "open"

    def format(self, number: str = "+.3g") -> str:
        """The value with its interval, as `number` formats them; – where a reason forbids it."""
        if not self.is_reliable or self.value is None or self.low is None or self.high is None:
            return "–"
        return f"{self.value:{number}} [{self.low:{number}}, {self.high:{number}}]"


UNMEASURED = Evidence(None, None, None)
