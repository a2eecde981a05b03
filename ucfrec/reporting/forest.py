"""Forest plot of estimates from logs: one line a policy, with its interval and verdict."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ucfrec.off_policy.estimators import LOGGED
from ucfrec.reporting.charts import (
    BAR_BOTTOM,
    LEFT_OF_BARS,
    NAME,
    NAME_CHARACTERS,
    TOP,
    WIDTH,
    Scale,
    Tick,
)
from ucfrec.reporting.page_results import Results, Row

_LINE = 18
"""Height of an interval and the gap below it."""
_STANDS, _FORBIDDEN = "the estimate stands", "do not rely on it"


@dataclass(frozen=True)
class Point:
    """An estimate with its interval, drawn below its name."""

    name: tuple[str, ...]
    """Lines of the name."""
    summary: str
    """Text alternative."""
    top: float
    y: float
    at: float
    low: float
    high: float
    stands: bool
    """Whether the verdict lets the estimate stand; if not, it is drawn hollow and dashed."""


@dataclass(frozen=True)
class Forest:
    """Estimates that share an axis."""

    title: str
    height: float
    ticks: tuple[Tick, ...]
    logged: float | None
    """Position of the logged sessions' mean return, a vertical line."""
    points: tuple[Point, ...]


def forest(results: Results) -> Forest | None:
    """Draw the estimate that each verdict is of; None if no policy has one with an interval."""
    drawn: list[tuple[str, Row, bool]] = []
    logged: list[float] = []
    for one in results.estimates:
        row = quoted(one.rows)
        if one.logged is not None:
            logged.append(float(one.logged["R_cum"]))
        if row is not None:
            drawn.append((f"{one.name}: {row['estimator']}", row, row.get("reliable") is True))
    if not drawn:
        return None
    # The line is of one set of logs; several have a line each in their own charts.
    reference = logged[0] if len(set(logged)) == 1 else None
    ends = [float(row[f"R_cum_{end}"]) for _, row, _ in drawn for end in ("low", "high")]
    x = Scale([*ends, *([] if reference is None else [reference])], LEFT_OF_BARS, WIDTH - 14)
    points, top = [], float(TOP)
    for name, row, stands in drawn:
        lines = tuple(textwrap.wrap(name, NAME_CHARACTERS))
        value, low, high = (float(row[key]) for key in ("R_cum", "R_cum_low", "R_cum_high"))
        summary = f"{name} {value:.4g}, 95% interval {low:.4g} to {high:.4g}, "
        summary += _STANDS if stands else _FORBIDDEN
        y = top + NAME * len(lines) + _LINE / 2
        points.append(Point(lines, summary, top, y, x.at(value), x.at(low), x.at(high), stands))
        top = y + _LINE
    title = "Mean return of a session by policy, with 95% intervals; dashed: do not rely on it"
    at = None if reference is None else x.at(reference)
    return Forest(title, top + BAR_BOTTOM, x.ticks(), at, tuple(points))


def quoted(rows: Sequence[Row]) -> Row | None:
    """The row that the verdict is of, if it has an interval; else the first weighted one."""
    with_interval = [row for row in rows if _has_interval(row) and row["estimator"] != LOGGED]
    for row in with_interval:
        if row["estimator"] == row.get("verdict_of"):
            return row
    preferred = {row["estimator"]: row for row in with_interval}
    return next((preferred[name] for name in ("DR", "SNPDIS", "SNIPS") if name in preferred), None)


def _has_interval(row: dict[str, Any]) -> bool:
    return row.get("R_cum_low") is not None and row.get("R_cum_high") is not None
