"""Forest plot of estimates from logs: one line a policy, with its interval and verdict."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

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
from ucfrec.reporting.page_results import Results
from ucfrec.results.row import ResultRow

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
    drawn: list[tuple[str, ResultRow, tuple[float, float]]] = []
    logged: list[float] = []
    for one in results.estimates:
        row = quoted(one.rows)
        if one.logged is not None:
            logged.append(one.logged.value)
        if row is not None and row.interval is not None:
            drawn.append((f"{one.name}: {row.method}", row, row.interval))
    if not drawn:
        return None
    # The line is of one set of logs; several have a line each in their own charts.
    reference = logged[0] if len(set(logged)) == 1 else None
    ends = [end for _, _, interval in drawn for end in interval]
    x = Scale([*ends, *([] if reference is None else [reference])], LEFT_OF_BARS, WIDTH - 14)
    points, top = [], float(TOP)
    for name, row, (low, high) in drawn:
        lines = tuple(textwrap.wrap(name, NAME_CHARACTERS))
        value, stands = row.value, row.details.get("reliable") is True
        summary = f"{name} {value:.4g}, 95% interval {low:.4g} to {high:.4g}, "
        summary += _STANDS if stands else _FORBIDDEN
        y = top + NAME * len(lines) + _LINE / 2
        points.append(Point(lines, summary, top, y, x.at(value), x.at(low), x.at(high), stands))
        top = y + _LINE
    title = "Mean return of a session by policy, with 95% intervals; dashed: do not rely on it"
    at = None if reference is None else x.at(reference)
    return Forest(title, top + BAR_BOTTOM, x.ticks(), at, tuple(points))


def quoted(rows: Sequence[ResultRow]) -> ResultRow | None:
    """The row that the verdict is of, if it has an interval."""
    of = (row for row in rows if row.interval and row.method == row.details.get("verdict_of"))
    return next(of, None)
