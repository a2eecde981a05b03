"""Rows to pictures (SVG), where matplotlib is installed (extra `plots`)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ucfrec.files import atomic_file
from ucfrec.reporting.grid import Row
from ucfrec_simulators.benchmark.tables import DISTRACTOR_RATES, grouped

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLAIN, OURS, LIGHT = "#7a8694", "#d55e00", "#56a8e0"
DISTRACTOR_NAMES: Final = ("no distractor", "distractor off", "distractor on")


def plot_methods(rows: Sequence[Row], folder: Path) -> list[Path]:
    """A picture a world: what every method earned, mean and standard deviation over seeds."""
    return [_saved(folder / f"methods-{world}.svg", _bars, own) for world, own in _by_world(rows)]


def plot_sweeps(rows: Sequence[Row], folder: Path) -> list[Path]:
    """The same of UCF's settings."""
    return [_saved(folder / f"sweeps-{world}.svg", _bars, own) for world, own in _by_world(rows)]


def plot_targets(rows: Sequence[Row], folder: Path) -> list[Path]:
    """A picture a world: target returns against what they earned in validation sessions."""
    asked = [row for row in rows if row.get("validation")]
    return [_saved(folder / f"targets-{world}.svg", _lines, own) for world, own in _by_world(asked)]


def plot_distractor(rows: Sequence[Row], folder: Path) -> list[Path]:
    """A picture a world in which a distractor was planted: returns without it, with it off and on,
    where the largest return is asked for."""
    rows = [row for row in rows if row["quantiles"] == [1.0]]
    told = {row["env"] for row in rows if row["distractor"] is not None}
    return [
        _saved(folder / f"distractor-{world}.svg", _triples, own)
        for world, own in _by_world([row for row in rows if row["env"] in told])
    ]


def _by_world(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    return grouped(rows, "best", lambda row: row["env"])


def _bars(axes: "Axes", rows: Sequence[Row]) -> None:
    named = grouped(rows, "best", lambda row: row["method"])[::-1]
    means = [np.mean([row["R_cum"] for row in own]) for _, own in named]
    spreads = [np.std([row["R_cum"] for row in own]) for _, own in named]
    colors = [OURS if name == "ucf" else PLAIN for name, _ in named]
    axes.barh([name for name, _ in named], means, xerr=spreads, color=colors, height=0.7)
    axes.set_xlabel("return of a session (mean ± sd over training seeds)")


def _lines(axes: "Axes", rows: Sequence[Row]) -> None:
    for name, own in grouped(rows, "best", lambda row: row["method"]):
        earned: dict[float, list[float]] = {}
        for row in own:
            for target, value in row["validation"].items():
                earned.setdefault(float(target), []).append(value)
        targets = sorted(earned)
        means = [np.mean(earned[target]) for target in targets]
        wide = 2.5 if name == "ucf" else 1
        axes.plot(targets, means, marker="o", markersize=3, linewidth=wide, label=name)
    axes.set_xlabel("target return asked for")
    axes.set_ylabel("return of a session, validation")
    axes.legend(fontsize=7, frameon=False)


def _triples(axes: "Axes", rows: Sequence[Row]) -> None:
    named = grouped(rows, "best", lambda row: row["method"])[::-1]
    colors = (PLAIN, OURS, LIGHT)
    for place, (distractor, label) in enumerate(
        zip(DISTRACTOR_RATES, DISTRACTOR_NAMES, strict=True)
    ):
        earned = [
            [row["R_cum"] for row in own if row["distractor"] == distractor] for _, own in named
        ]
        means = [np.mean(values) if values else np.nan for values in earned]
        at = np.arange(len(named)) + 0.25 * (1 - place)
        axes.barh(at, means, height=0.25, color=colors[place], label=label)
    axes.set_yticks(range(len(named)), [name for name, _ in named])
    axes.set_xlabel("return of a session (mean over training seeds)")
    axes.legend(fontsize=7, frameon=False)


def _saved(path: Path, draw: Callable[["Axes", Sequence[Row]], None], rows: Sequence[Row]) -> Path:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    # Text stays text, and the same rows give the same bytes.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": path.name}):
        figure = Figure(figsize=(5.2, 4.2), layout="constrained")
        axes = figure.add_subplot()
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(path.stem)
        draw(axes, rows)
        with atomic_file(path) as scratch:
            figure.savefig(scratch, format="svg", metadata={"Date": None})
    return path
