"""Charts by matplotlib: SVG that is part of a page of the report or explorer, and files.

Colors are variables of the page's style sheet (`--ink`, `--soft`, `--rule`, `--paper`, `--c0` to
`--c7`), so that a chart is legible in light and dark; text stays text. Files have the style of a
paper's figures. Matplotlib is imported when a chart is drawn.
"""

import html
import io
import re
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ucfrec.errors import one_line
from ucfrec.files.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 360, 220
"""Size of line charts and histograms in SVG units, which are points in matplotlib; charts of
intervals have the same width. A phone is about as wide, so that text is not scaled there."""
_VARIABLES: Final = ("ink", "soft", "rule", "paper", *(f"c{series}" for series in range(8)))
# Colors that matplotlib writes into the SVG, where variables take their places.
_COLORS: Final = {f"#01{number:02x}fe": name for number, name in enumerate(_VARIABLES)}
INK, SOFT, RULE, PAPER, *SERIES = _COLORS
_DASHES: Final = ("solid", "dashed", "dotted")
_SHARED_STYLE: Final[Any] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "figure.constrained_layout.use": True,
    # Text stays text in SVG, and equal figures give identical files.
    "svg.fonttype": "none",
    "svg.hashsalt": "ucfrec",
}
_STYLE: Final[Any] = {
    **_SHARED_STYLE,
    "font.size": 11,
    "text.color": INK,
    "text.parse_math": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": SOFT,
    "axes.formatter.useoffset": False,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "grid.color": RULE,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "lines.linewidth": 2,
}
_NAME, _BAR, _BOTTOM = 16, 28, 26
"""Heights of a line of a name, of the bar below it with a gap, and of the axis below all."""
_NAME_CHARACTERS: Final = 48
_MOST_LABELS: Final = 6


@dataclass(frozen=True)
class Chart:
    """A picture with its text alternative."""

    title: str
    summary: str
    svg: str
    """An element of a page, with the summary as its label; its texts are escaped."""


@dataclass(frozen=True)
class Interval:
    """A value with its 95% interval."""

    name: str
    value: float
    low: float
    high: float
    reliable: bool | None = None
    """Whether a verdict lets the value stand; None where there is no verdict."""

    @property
    def summary(self) -> str:
        """The numbers, and the verdict in words."""
        verdicts = {True: ", the estimate stands", False: ", do not rely on it", None: ""}
        ends = f"95% interval {self.low:.4g} to {self.high:.4g}"
        return f"{self.name}: {self.value:.4g}, {ends}{verdicts[self.reliable]}"


@contextmanager
def page_style() -> Iterator[None]:
    """The style of a chart, for the block or function that draws it."""
    from matplotlib import rc_context

    with rc_context(_STYLE), warnings.catch_warnings():
        # Browsers have other fonts for the glyphs that matplotlib's font lacks.
        warnings.filterwarnings("ignore", message="Glyph ", category=UserWarning)
        yield


@page_style()
def line_chart(
    title: str,
    x_label: str,
    curves: Sequence[tuple[str, int, Mapping[float, float]]],
    levels: Mapping[str, float] | None = None,
) -> Chart:
    """Draw curves in one chart.

    Args:
        curves: (name, style, {x: y}) of each; at least one point, y finite. A run has the same
            style, which is its color and dashes, in all charts.
        levels: name to a finite reference value, drawn as a horizontal line; at most two.
    """
    figure, axes = _plot_axes(x_label)
    summaries = []
    for name, style, curve in curves:
        x, y = zip(*sorted(curve.items()), strict=True)
        color, dashes = SERIES[style % 8], _DASHES[style // 8 % 3]
        marker = "o" if len(x) == 1 else ""
        axes.plot(x, y, marker=marker, clip_on=False, color=color, linestyle=dashes)
        summaries.append(
            f"{name}: {y[0]:.4g} at {x[0]:g}, {y[-1]:.4g} at {x[-1]:g}, lowest {min(y):.4g} at "
            f"{x[y.index(min(y))]:g}"
        )
    ordered = sorted((levels or {}).items(), key=lambda level: -level[1])
    for (name, value), side in zip(ordered, ("bottom", "top"), strict=False):
        axes.axhline(value, color=INK, linestyle="dotted", linewidth=1)
        place, text = axes.get_yaxis_transform(), f"{name}: {value:.4g}"
        axes.text(1, value, one_line(text), transform=place, ha="right", va=side)
        summaries.append(f"For comparison, {text}")
    for axis in (axes.xaxis, axes.yaxis):
        _format_labels(axis)
    return render(figure, title, ". ".join(summaries))


@page_style()
def histogram(title: str, x_label: str, counts: Sequence[float], names: Sequence[str]) -> Chart:
    """Draw counts (N,) of N named bins as columns of equal width, whatever the bins' widths."""
    figure, axes = _plot_axes(x_label)
    axes.bar(range(len(counts)), counts, width=0.95, color=SERIES[0], alpha=0.55)
    labels = {}
    for number in range(0, len(counts), -(-len(counts) // _MOST_LABELS)):
        # The label of a range is at its lower edge, that of a value below the middle of its column.
        low, end, _ = names[number].partition(" to ")
        labels[number - 0.5 if end else number] = low
    axes.set_xticks(list(labels), list(labels.values()))
    _format_labels(axes.yaxis)
    most = int(np.argmax(counts))
    highest = f"{names[most]}: {counts[most]:,.6g}"
    summary = f"{len(counts)} columns from {names[0]} to {names[-1]}; the highest is {highest}"
    return render(figure, title, summary)


def name_bins(edges: Sequence[float] | None, values: Sequence[float] | None) -> list[str]:
    """Names of the bins of a histogram, by their edges (N + 1,) or by the counted values (N,)."""
    if edges is not None:
        return [f"{_short(low)} to <{_short(high)}" for low, high in pairwise(edges)]
    return [_short(value) for value in values or ()]


@page_style()
def interval_chart(title: str, intervals: Sequence[Interval], logged: float | None = None) -> Chart:
    """Draw values with their intervals one below the other, that of logged sessions as a line.

    Values without a verdict are bars from 0; others are dots, hollow and dashed where the verdict
    forbids to rely on them.
    """
    from matplotlib.figure import Figure

    names = [textwrap.wrap(one_line(row.name), _NAME_CHARACTERS) or [""] for row in intervals]
    tops = np.cumsum([0, *(_NAME * len(lines) + _BAR for lines in names)])
    height = max(int(tops[-1]), 1) + _BOTTOM
    figure = Figure(figsize=(WIDTH / 72, height / 72))
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.04, _BOTTOM / height, 0.92, 1 - _BOTTOM / height))
    axes.set_ylim(height - _BOTTOM, 0)
    axes.set_yticks([])
    axes.spines[["left"]].set_visible(any(interval.reliable is None for interval in intervals))
    axes.spines[["left"]].set_position(("data", 0))
    axes.grid(axis="x")
    for top, lines, interval in zip(tops, names, intervals, strict=False):
        middle = top + _NAME * len(lines) + 9
        dashes = "dashed" if interval.reliable is False else "solid"
        place = axes.get_yaxis_transform()
        axes.text(0.01, top + 2, "\n".join(lines), transform=place, va="top", size=12)
        if interval.reliable is None:
            axes.barh(middle, interval.value, height=16, color=SERIES[0], alpha=0.55)
        else:
            fill = SERIES[0] if interval.reliable else PAPER
            axes.plot(interval.value, middle, "o", color=SERIES[0], markerfacecolor=fill, zorder=3)
        axes.plot((interval.low, interval.high), (middle, middle), "|", color=INK, markersize=8)
        axes.hlines(middle, interval.low, interval.high, color=INK, linewidth=1, linestyle=dashes)
    summaries = [interval.summary for interval in intervals]
    if logged is not None:
        summaries.append(f"For comparison, logged sessions: {logged:.4g}")
        axes.axvline(logged, color=INK, linestyle="dotted", linewidth=1)
    _format_labels(axes.xaxis)
    return render(figure, title, ". ".join(summaries))


def _plot_axes(x_label: str) -> "tuple[Figure, Axes]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH / 72, HEIGHT / 72))
    axes = figure.add_subplot()
    axes.set_xlabel(one_line(x_label), loc="right")
    axes.grid(axis="y")
    return figure, axes


def _format_labels(axis: "Axis") -> None:
    """At most five labels, in thousands or millions where they are large."""
    axis.get_major_locator().set_params(nbins=5)  # type: ignore[call-arg]
    if max(map(abs, axis.get_view_interval())) >= 10_000:
        axis.set_major_formatter(lambda value, _: _short(value))


def _short(value: float) -> str:
    if abs(value) >= 10_000:
        return f"{value / 1e6:.4g}M" if abs(value) >= 1e6 else f"{value / 1e3:.4g}k"
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.3g}"


def render(figure: "Figure", title: str, summary: str) -> Chart:
    """The figure as an `<svg>` of a page, with variables for its colors, without style sheet and
    names of groups, which would be of the whole page; matplotlib escapes texts."""
    file = io.StringIO()
    none = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(file, format="svg", metadata=none)
    text = file.getvalue()
    box = re.search(r'viewBox="[\d. ]+"', text)
    assert box is not None
    body = text[text.index("</defs>") + len("</defs>") :]
    body = re.sub(r'<g id="[\w.]+"', "<g", body).replace("xlink:href", "href")
    body = re.sub(r"(?<=: )#01\w\wfe(?=[;\"])", lambda color: f"var(--{_COLORS[color[0]]})", body)
    body = re.sub(r"font-family: [^;\"]*;? ?", "", body)
    label = html.escape(one_line(f"{title}. {summary}"))
    return Chart(title, summary, f'<svg {box[0]} role="img" aria-label="{label}">{body}')


# Figures that are files: colors and the column widths of a paper.
COLUMN, PAGE = 3.4, 7.0
"""Widths of one column and of the whole page, in inches."""
PLAIN, OURS = "#8C8C8C", "#D55E00"
"""Colors of other methods, and of UCF."""
_NOT_IN_NAMES: Final = re.compile(r"[^\w,.= -]+")

_FILE_STYLE: Final[Any] = {
    **_SHARED_STYLE,
    "figure.dpi": 200,
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "grid.color": "#DDDDDD",
    "lines.linewidth": 1.3,
    "lines.markersize": 3.5,
    "image.cmap": "cividis",
}


@contextmanager
def file_style() -> Iterator[None]:
    """The style of a figure that is a file, for the block or function that draws or saves it."""
    from matplotlib import rc_context

    with rc_context(_FILE_STYLE):
        yield


@file_style()
def save(figure: "Figure", folder: Path, name: str) -> list[Path]:
    """Write `figure` as `name.png` and `name.svg` in `folder`, atomically; characters of the name
    that a path gives a meaning become "-"."""
    files = []
    for kind in ("png", "svg"):
        path = folder / f"{_NOT_IN_NAMES.sub('-', name)}.{kind}"
        with atomic_file(path) as scratch:
            # A date in the metadata would make the SVG files of equal figures differ.
            figure.savefig(scratch, format=kind, metadata={"Date": None})
        files.append(path)
    return files
