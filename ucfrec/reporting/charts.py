"""Chart geometry that the report's template draws as SVG; lengths are in SVG user units."""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

WIDTH, HEIGHT = 360, 220
"""Size of line charts and histograms; bar charts have the same width. A phone is about as wide, so
that text is not scaled there."""
LEFT, RIGHT, TOP, BOTTOM = 52, 22, 16, 40
"""Margins around the plot area."""
BAR_BOTTOM = 26
"""Bottom margin of bar charts, whose axis has no label."""
LEFT_OF_BARS = 14
"""Left and right margin of bar charts, whose names are above the bars."""
NAME, _BAR, _GAP = 16, 18, 10
"""Heights of one line of a bar's name, of the bar, and of the gap below it."""
NAME_CHARACTERS = 48
"""Most characters in a line of a bar's name."""
_LABEL = 14
"""Height of a label."""
_X_LABELS = 6
"""Most labels below a histogram."""


@dataclass(frozen=True)
class Tick:
    """A labelled position on an axis."""

    at: float
    label: str


@dataclass(frozen=True)
class Line:
    """One curve."""

    summary: str
    """Text alternative: name, first, last and lowest value."""
    style: int
    """Number of the color and dashes; a run has the same in all charts."""
    points: str
    """Value of the SVG attribute `points`."""


@dataclass(frozen=True)
class Level:
    """A reference value, drawn as a horizontal line."""

    y: float
    label: str
    label_y: float
    """Baseline of the label: above the line, or below it if another label is there."""


@dataclass(frozen=True)
class LineChart:
    """Curves that share axes."""

    title: str
    x_label: str
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    lines: tuple[Line, ...]
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class Bar:
    """A horizontal bar with an interval, drawn below its name."""

    name: tuple[str, ...]
    """Lines of the name."""
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
    """Bars that share an axis, which includes 0."""

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
    """Counts of consecutive bins, all drawn with the same width."""

    title: str
    summary: str
    x_label: str
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    columns: tuple[Column, ...]


class Scale:
    """Linear map from values to positions, with ticks at round values."""

    def __init__(self, values: Iterable[float], start: float, end: float) -> None:
        listed = list(values)
        low, high = min(listed), max(listed)
        if low == high:  # a single value is drawn in the middle
            low, high = low - (abs(low) or 1.0) / 2, high + (abs(high) or 1.0) / 2
        self._step = _round_step((high - low) / 4)
        self._low = math.floor(low / self._step) * self._step
        self._high = math.ceil(high / self._step) * self._step
        self._start, self._end = start, end

    def at(self, value: float) -> float:
        """Position of a value."""
        share = (value - self._low) / (self._high - self._low)
        return round(self._start + share * (self._end - self._start), 2)

    def ticks(self) -> tuple[Tick, ...]:
        """Labelled positions of round values, the ends of the scale among them."""
        first, last = round(self._low / self._step), round(self._high / self._step)
        values = [i * self._step for i in range(first, last + 1)]
        return tuple(Tick(self.at(value), _label(value, self._step)) for value in values)


def _label(value: float, step: float) -> str:
    """Label of a tick; in thousands or millions if the distance `step` of the ticks is."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if step >= size and value:
            return f"{value / size:,.0f}{unit}"
    return f"{value:,.{max(0, -math.floor(math.log10(step)))}f}"


def _round_step(least: float) -> float:
    """The smallest number ≥ `least` that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= least * (1 - 1e-9))


def line_chart(
    title: str,
    x_label: str,
    curves: Sequence[tuple[str, int, Mapping[float, float]]],
    levels: Mapping[str, float] | None = None,
) -> LineChart:
    """Draw curves in one chart.

    Args:
        curves: (name, style, {x: y}) of each; at least one point, y finite.
        levels: name to a finite reference value, drawn as a horizontal line.
    """
    levels = levels or {}
    values = [value for _, _, curve in curves for value in curve.values()]
    x = Scale((at for _, _, curve in curves for at in curve), LEFT, WIDTH - RIGHT)
    y = Scale([*values, *levels.values()], HEIGHT - BOTTOM, TOP)
    lines = tuple(_line(name, style, curve, x, y) for name, style, curve in curves)
    return LineChart(title, x_label, x.ticks(), y.ticks(), lines, _levels(levels, y))


def _levels(levels: Mapping[str, float], y: Scale) -> tuple[Level, ...]:
    drawn: list[Level] = []
    for name, value in sorted(levels.items(), key=lambda level: -level[1]):
        at = y.at(value)
        close = drawn and at - drawn[-1].y < _LABEL
        drawn.append(Level(at, f"{name}: {value:.4g}", at + (_LABEL - 2 if close else -4)))
    return tuple(drawn)


def _line(name: str, style: int, curve: Mapping[float, float], x: Scale, y: Scale) -> Line:
    ordered = sorted(curve.items())
    lowest = min(ordered, key=lambda point: point[1])
    summary = (
        f"{name}: {ordered[0][1]:.4g} at {ordered[0][0]:g}, {ordered[-1][1]:.4g} at "
        f"{ordered[-1][0]:g}, lowest {lowest[1]:.4g} at {lowest[0]:g}"
    )
    # The first point is repeated, so that a single point is a line of length 0, drawn as a dot.
    positions = [f"{x.at(at)},{y.at(value)}" for at, value in (ordered[0], *ordered)]
    return Line(summary, style, " ".join(positions))


def bar_chart(title: str, bars: Sequence[tuple[str, float, float, float]]) -> BarChart:
    """Draw horizontal bars one below the other.

    Args:
        bars: (name, value, low, high) of each, with the ends of its 95% interval.
    """
    values = [0.0, *(end for bar in bars for end in bar[1:])]
    x = Scale(values, LEFT_OF_BARS, WIDTH - LEFT_OF_BARS)
    drawn, top = [], float(TOP)
    for name, value, low, high in bars:
        start, end = sorted((x.at(0), x.at(value)))
        summary = f"{name}: {value:.4g}, 95% interval {low:.4g} to {high:.4g}"
        lines = tuple(textwrap.wrap(name, NAME_CHARACTERS)) or ("",)
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
    """Draw counts as columns of equal width, whatever the width of their bins.

    Args:
        counts: (N,).
        edges: (N + 1,) ascending bin edges; a bin includes its left edge but not its right one.
        values: (N,) counted values, instead of `edges`.
    """
    y = Scale([0.0, *counts], HEIGHT - BOTTOM, TOP)
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
    # Labels of edges are at the edges, those of values below the middle of their column.
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
