"""Charts as geometry: what the report's template draws as SVG."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 440, 240
"""Of a line chart, in the units of its drawing; bar charts are as wide."""
LEFT, RIGHT, TOP, BOTTOM = 56, 14, 12, 40
"""Margins around what is plotted."""
_NAMES = 170
_ROW = 24


@dataclass(frozen=True)
class Tick:
    """A value on an axis and where it is drawn."""

    at: float
    label: str


@dataclass(frozen=True)
class Line:
    """One curve."""

    summary: str
    """Its name, ends and lowest value, for those who cannot see it."""
    style: int
    """Color and dashes; a run has the same in all charts."""
    points: str
    """As SVG takes them."""


@dataclass(frozen=True)
class LineChart:
    """Curves over one pair of axes."""

    title: str
    x_label: str
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Bar:
    """A value and its interval, drawn along x."""

    name: str
    summary: str
    y: float
    start: float
    end: float
    low: float
    high: float


@dataclass(frozen=True)
class BarChart:
    """Bars that share an axis with 0 on it."""

    title: str
    height: float
    zero: float
    ticks: tuple[Tick, ...]
    bars: tuple[Bar, ...]


class _Scale:
    """Values to places, linearly, with ticks at round values."""

    def __init__(self, values: Iterable[float], start: float, end: float) -> None:
        known = list(values)
        low, high = min(known), max(known)
        if low == high:  # one value alone lies in the middle
            low, high = low - (abs(low) or 1.0) / 2, high + (abs(high) or 1.0) / 2
        self._step = _round_step((high - low) / 4)
        self._low = math.floor(low / self._step) * self._step
        self._high = math.ceil(high / self._step) * self._step
        self._start, self._end = start, end

    def at(self, value: float) -> float:
        share = (value - self._low) / (self._high - self._low)
        return round(self._start + share * (self._end - self._start), 2)

    def ticks(self) -> tuple[Tick, ...]:
        digits = max(0, -math.floor(math.log10(self._step)))
        first, last = math.ceil(self._low / self._step), round(self._high / self._step)
        values = [i * self._step for i in range(first, last + 1)]
        return tuple(Tick(self.at(value), f"{value:,.{digits}f}") for value in values)


def _round_step(least: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is `least` or more."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= least * (1 - 1e-9))


def line_chart(
    title: str, x_label: str, curves: Sequence[tuple[str, int, Mapping[float, float]]]
) -> LineChart:
    """Curves (name, style, {x: y}) overlaid; each has a point at least, and y is finite."""
    x = _Scale((at for _, _, curve in curves for at in curve), LEFT, WIDTH - RIGHT)
    y = _Scale((v for _, _, curve in curves for v in curve.values()), HEIGHT - BOTTOM, TOP)
    lines = tuple(_line(name, style, curve, x, y) for name, style, curve in curves)
    return LineChart(title, x_label, x.ticks(), y.ticks(), lines)


def _line(name: str, style: int, curve: Mapping[float, float], x: _Scale, y: _Scale) -> Line:
    ordered = sorted(curve.items())
    lowest = min(ordered, key=lambda point: point[1])
    summary = (
        f"{name}: {ordered[0][1]:.4g} at {ordered[0][0]:g}, {ordered[-1][1]:.4g} at "
        f"{ordered[-1][0]:g}, lowest {lowest[1]:.4g} at {lowest[0]:g}"
    )
    # The first point comes twice: a lone point is then a stroke of no length, drawn as a dot.
    places = [f"{x.at(at)},{y.at(value)}" for at, value in (ordered[0], *ordered)]
    return Line(summary, style, " ".join(places))


def bar_chart(title: str, bars: Sequence[tuple[str, float, float, float]]) -> BarChart:
    """Bars (name, value, low, high) one below the other."""
    x = _Scale([0.0, *(end for bar in bars for end in bar[1:])], _NAMES, WIDTH - RIGHT)
    drawn = []
    for row, (name, value, low, high) in enumerate(bars):
        start, end = sorted((x.at(0), x.at(value)))
        summary = f"{name}: {value:.4g}, 95% interval {low:.4g} to {high:.4g}"
        y = TOP + _ROW * (row + 0.5)
        drawn.append(Bar(name, summary, y, start, end, x.at(low), x.at(high)))
    height = TOP + _ROW * len(bars) + BOTTOM
    return BarChart(title, height, x.at(0), x.ticks(), tuple(drawn))
