"""Charts as geometry: what the report's template draws as SVG."""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

WIDTH, HEIGHT = 360, 220
"""Of line charts and histograms, in units of the drawing; bar charts are as wide. About as wide as
a phone, so that text keeps its size there."""
LEFT, RIGHT, TOP, BOTTOM = 52, 22, 16, 40
"""Margins around what is plotted."""
BAR_BOTTOM = 26
"""Of bar charts, whose axis needs no name."""
LEFT_OF_BARS = 14
"""Margin at both sides of a bar chart, whose names stand above their bars."""
NAME, _BAR, _GAP = 16, 18, 10
"""Height of a line of a bar's name, of the bar, and of the space below it."""
_NAME_CHARACTERS = 48
_LABEL = 14
"""Height of a label."""
_X_LABELS = 6
"""Labels below a histogram, at most."""


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
class Level:
    """A value that curves are compared with, drawn across."""

    y: float
    label: str
    label_y: float
    """Above the line, or below it where another label stands above."""


@dataclass(frozen=True)
class LineChart:
    """Curves over one pair of axes."""

    title: str
    x_label: str
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    lines: tuple[Line, ...]
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class Bar:
    """A value and its interval, drawn along x under its name."""

    name: tuple[str, ...]
    """In lines."""
    summary: str
    top: float
    y: float
    """Middle of the bar."""
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


@dataclass(frozen=True)
class Column:
    """One bin of a histogram."""

    name: str
    summary: str
    x: float
    width: float
    y: float
    height: float


@dataclass(frozen=True)
class Histogram:
    """Counts of neighbouring bins, all drawn equally wide."""

    title: str
    summary: str
    x_label: str
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    columns: tuple[Column, ...]


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
        first, last = round(self._low / self._step), round(self._high / self._step)
        values = [i * self._step for i in range(first, last + 1)]
        return tuple(Tick(self.at(value), _label(value, self._step)) for value in values)


def _label(value: float, step: float) -> str:
    """A value of an axis whose ticks are `step` apart; in thousands or millions if all are."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if step >= size and value:
            return f"{value / size:,.0f}{unit}"
    return f"{value:,.{max(0, -math.floor(math.log10(step)))}f}"


def _round_step(least: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is `least` or more."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= least * (1 - 1e-9))


def line_chart(
    title: str,
    x_label: str,
    curves: Sequence[tuple[str, int, Mapping[float, float]]],
    levels: Mapping[str, float] | None = None,
) -> LineChart:
    """Curves (name, style, {x: y}) overlaid; each has a point at least, and y is finite.

    Args:
        levels: finite values to compare the curves with, by name.
    """
    levels = levels or {}
    values = [value for _, _, curve in curves for value in curve.values()]
    x = _Scale((at for _, _, curve in curves for at in curve), LEFT, WIDTH - RIGHT)
    y = _Scale([*values, *levels.values()], HEIGHT - BOTTOM, TOP)
    lines = tuple(_line(name, style, curve, x, y) for name, style, curve in curves)
    return LineChart(title, x_label, x.ticks(), y.ticks(), lines, _levels(levels, y))


def _levels(levels: Mapping[str, float], y: _Scale) -> tuple[Level, ...]:
    drawn: list[Level] = []
    for name, value in sorted(levels.items(), key=lambda level: -level[1]):
        at = y.at(value)
        close = drawn and at - drawn[-1].y < _LABEL
        drawn.append(Level(at, f"{name}: {value:.4g}", at + (_LABEL - 2 if close else -4)))
    return tuple(drawn)


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
    """Bars (name, value, low, high) one below the other, each under its whole name."""
    values = [0.0, *(end for bar in bars for end in bar[1:])]
    x = _Scale(values, LEFT_OF_BARS, WIDTH - LEFT_OF_BARS)
    drawn, top = [], float(TOP)
    for name, value, low, high in bars:
        start, end = sorted((x.at(0), x.at(value)))
        summary = f"{name}: {value:.4g}, 95% interval {low:.4g} to {high:.4g}"
        lines = tuple(textwrap.wrap(name, _NAME_CHARACTERS)) or ("",)
        y = top + NAME * len(lines) + _BAR / 2
        drawn.append(Bar(lines, summary, top, y, start, end, x.at(low), x.at(high)))
        top = y + _BAR / 2 + _GAP
    return BarChart(title, top + BAR_BOTTOM, x.at(0), x.ticks(), tuple(drawn))


def histogram(
    title: str,
    x_label: str,
    counts: Sequence[float],
    edges: Sequence[float] | None = None,
    values: Sequence[float] | None = None,
) -> Histogram:
    """Columns of `counts` (N,), all equally wide: bins that widen show a long tail.

    Args:
        edges: (N + 1,) of the bins, rising; the left one belongs to the bin, the right one not.
        values: (N,) what is counted, where there are no bins.
    """
    y = _Scale([0.0, *counts], HEIGHT - BOTTOM, TOP)
    width = (WIDTH - LEFT - RIGHT) / len(counts)
    names = [_short(value) for value in values or ()]
    if edges is not None:
        names = [f"{_short(low)} to <{_short(high)}" for low, high in pairwise(edges)]
    columns = tuple(
        Column(
            name,
            f"{name}: {count:,.6g}",
            round(LEFT + i * width, 2),
            round(width, 2),
            y.at(count),
            round(y.at(0) - y.at(count), 2),
        )
        for i, (name, count) in enumerate(zip(names, counts, strict=True))
    )
    # Edges are labelled where they lie, values below the middle of their column.
    labels, shift = (edges, 0.0) if edges is not None else (values or (), width / 2)
    labelled = range(0, len(labels), -(-len(labels) // _X_LABELS))
    ticks = tuple(Tick(round(LEFT + i * width + shift, 2), _short(labels[i])) for i in labelled)
    most = max(columns, key=lambda column: column.height)
    summary = f"{len(counts)} columns from {names[0]} to {names[-1]}; the highest is {most.summary}"
    return Histogram(title, summary, x_label, ticks, y.ticks(), columns)


def _short(value: float) -> str:
    if abs(value) >= 10_000:
        return f"{value / 1e6:.4g}M" if abs(value) >= 1e6 else f"{value / 1e3:.4g}k"
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.3g}"
