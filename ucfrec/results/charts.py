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
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ucfrec.errors import one_line
from ucfrec.files.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 360, 220
"""Size of line charts in SVG units, which are points in matplotlib; charts of
intervals have the same width. A phone is about as wide, so that text is not scaled there."""
_VARIABLES = ("ink", "soft", "rule", "paper", *(f"c{series}" for series in range(8)))
# Colors that matplotlib writes into the SVG, where variables take their places.
_COLORS = {f"#01{number:02x}fe": name for number, name in enumerate(_VARIABLES)}
INK, SOFT, RULE, PAPER, *SERIES = _COLORS
_DASHES = ("solid", "dashed", "dotted")
_SHARED_STYLE: Any = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "figure.constrained_layout.use": True,
    # Text stays text in SVG, and equal figures give identical files.
    "svg.fonttype": "none",
    "svg.hashsalt": "ucfrec",
}
_STYLE: Any = {
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
    "axes.prop_cycle": f"cycler(color={SERIES})",
}
_LINE, _BAR, _BOTTOM = 16, 28, 26
"""Heights of a line of a label, of the bar below it with a gap, and of the axis below all."""
_LABEL_CHARACTERS = 48
_NO_BREAK = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class Chart:
    """A picture with its text alternative."""

    title: str
    summary: str
    svg: str
    """An element of a page, with the summary as its label; its texts are escaped."""


@dataclass(frozen=True)
class Interval:
    """A value with its 95% interval, whose ends are the value where it is not known."""

    name: str
    value: float
    low: float
    high: float
    reliable: bool = True
    """Whether the value can be relied on; otherwise no number of it is drawn or said."""

    @property
    def numbers(self) -> str:
        """The value with the interval in brackets."""
        if not self.reliable:
            return "the data cannot say"
        ends = f" [{self.low:.4g}, {self.high:.4g}]" if self.low < self.high else ""
        return f"{self.value:.4g}{ends}"

    def __str__(self) -> str:
        return f"{self.name}: {self.numbers}"


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
) -> Chart:
    """Draw curves in one chart.

    Args:
        curves: (name, style, {x: y}) of each; at least one point, y finite. A run has the same
            style, which is its color and dashes, in all charts.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH / 72, HEIGHT / 72))
    axes = figure.add_subplot()
    axes.set_xlabel(one_line(x_label), loc="right")
    axes.grid(axis="y")
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
    for axis in (axes.xaxis, axes.yaxis):
        _format_labels(axis)
    return render(figure, title, ". ".join(summaries))


@page_style()
def interval_chart(
    title: str, intervals: Sequence[Interval], level: tuple[str, float] | None = None
) -> Chart:
    """Draw values with their intervals one below the other, and a level to compare them with."""
    from matplotlib.figure import Figure

    figure = Figure()
    height = draw_intervals(figure.add_subplot(), intervals, level)
    figure.set_size_inches(WIDTH / 72, height / 72)
    summaries = list(map(str, intervals))
    if level is not None:
        summaries.append(f"For comparison, {level[0]}: {level[1]:.4g}")
    return render(figure, title, ". ".join(summaries))


def draw_intervals(
    axes: "Axes", intervals: Sequence[Interval], level: tuple[str, float] | None = None
) -> float:
    """Draw what `interval_chart` does into axes, in the colors of matplotlib's settings; returns
    the height in points that suits it."""
    from matplotlib import rcParams

    # Numbers have spaces that do not break.
    texts = [f"{one_line(i.name)}: {i.numbers.replace(' ', _NO_BREAK)}" for i in intervals]
    labels = [textwrap.fill(text, _LABEL_CHARACTERS) for text in texts]
    slot = _LINE * max((label.count("\n") + 1 for label in labels), default=1) + _BAR
    top = _LINE / slot if level else 0.0
    axes.set(ylim=(max(len(labels), 1), -top), yticks=[])
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    place, soft = axes.get_yaxis_transform(), rcParams["xtick.color"]
    for number, (label, interval) in enumerate(zip(labels, intervals, strict=True)):
        middle, color = number + 1 - 19 / slot, rcParams["text.color"]
        if interval.reliable:
            axes.hlines(middle, interval.low, interval.high, color=color, linewidth=1)
            axes.plot((interval.low, interval.high), (middle, middle), "|", color=color)
            axes.plot(interval.value, middle, "o", color="C0", zorder=3)
        else:
            color = soft
            axes.axhspan(middle - 8 / slot, middle + 8 / slot, facecolor=rcParams["grid.color"])
        above = middle - 10 / slot
        axes.text(
            0.01, above, label, transform=place, color=color, va="bottom", size=12, in_layout=False
        )
    if level is not None:
        axes.axvline(level[1], color=soft, linestyle="dotted", linewidth=1)
        axes.margins(x=0.1)
        left, right = axes.get_xlim()
        side = "left" if 2 * level[1] < left + right else "right"
        text = f" {level[0]}: {level[1]:.4g} "
        axes.text(level[1], -top, one_line(text), color=soft, ha=side, va="top", in_layout=False)
    elif not any(interval.reliable for interval in intervals):
        axes.set_xticks([])
    _format_labels(axes.xaxis)
    return slot * max(len(labels), 1) + top * slot + _BOTTOM


def _format_labels(axis: "Axis") -> None:
    """At most five labels, in thousands or millions where they are large."""
    from matplotlib.ticker import EngFormatter

    axis.get_major_locator().set_params(nbins=5)  # type: ignore[call-arg]
    if max(map(abs, axis.get_view_interval())) >= 10_000:
        axis.set_major_formatter(EngFormatter(sep=""))


def render(figure: "Figure", title: str, summary: str) -> Chart:
    """The figure as an `<svg>` of a page, with variables for its colors, without style sheet and
    names of groups, which would be of the whole page; matplotlib escapes texts."""
    file = io.StringIO()
    none = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(file, format="svg", metadata=none)
    head, _, body = file.getvalue().partition("</defs>")
    (box,) = re.findall(r'viewBox="[\d. ]+"', head)
    body = re.sub(r'<g id="[\w.]+"', "<g", body).replace("xlink:href", "href")
    body = re.sub(r"(?<=: )#01\w\wfe(?=[;\"])", lambda color: f"var(--{_COLORS[color[0]]})", body)
    body = re.sub(r"font-family: [^;\"]*;? ?", "", body)
    label = html.escape(one_line(f"{title}. {summary}"))
    return Chart(title, summary, f'<svg {box} role="img" aria-label="{label}">{body}')


# Figures that are files: colors and the column widths of a paper.
COLUMN, PAGE = 3.4, 7.0
"""Widths of one column and of the whole page, in inches."""
PLAIN, OURS = "#8C8C8C", "#D55E00"
"""Colors of other methods, and of UCF."""
_NOT_IN_NAMES = re.compile(r"[^\w,.= -]+")

_FILE_STYLE: Any = {
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
