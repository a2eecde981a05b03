"""Rows to pictures, where matplotlib is installed (extra `plots`)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ucfrec.reporting.plot_style import LIGHT, OURS, PLAIN, save, styled
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.statistics import grouped, summary
from ucfrec_simulators.benchmark.tables import DISTRACTOR_RATES, earned_by_target, of_checkpoint

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DISTRACTOR_NAMES: Final = ("no distractor", "distractor off", "distractor on")
_Rows = Sequence[ResultRow]


def plot_methods(rows: _Rows, folder: Path) -> list[Path]:
    """A picture a world: what every method earned, mean and standard deviation over seeds."""
    return _by_world("methods", _bars, rows, folder)


def plot_sweeps(rows: _Rows, folder: Path) -> list[Path]:
    """The same of UCF's settings."""
    return _by_world("sweeps", _bars, rows, folder)


def plot_targets(rows: _Rows, folder: Path) -> list[Path]:
    """A picture a world: target returns against what they earned in validation sessions."""
    tried = [row for row in rows if row.details.get("validation")]
    return _by_world("targets", _lines, tried, folder)


def plot_distractor(rows: _Rows, folder: Path) -> list[Path]:
    """A picture a world in which a distractor was planted: returns without it, with it off and on,
    where the target is the largest return."""
    rows = [row for row in rows if row.conditions["quantiles"] == "1"]
    planted = {row.world for row in rows if row.conditions["distractor"] is not None}
    return _by_world("distractor", _triples, [r for r in rows if r.world in planted], folder)


def _bars(axes: "Axes", rows: _Rows) -> None:
    named = list(grouped(rows, lambda row: row.method).items())[::-1]
    earned = [summary(row.value for row in own) for _, own in named]
    colors = [OURS if name == "ucf" else PLAIN for name, _ in named]
    means, spreads = [found.mean for found in earned], [found.sd for found in earned]
    axes.barh([name for name, _ in named], means, xerr=spreads, color=colors, height=0.7)
    axes.set_xlabel("return of a session (mean ± sd over training seeds)")


def _lines(axes: "Axes", rows: _Rows) -> None:
    for name, own in grouped(rows, lambda row: row.method).items():
        earned = earned_by_target(own)
        means = [summary(values).mean for values in earned.values()]
        wide = 2.5 if name == "ucf" else 1
        axes.plot(list(earned), means, marker="o", linewidth=wide, label=name)
    axes.set_xlabel("target return")
    axes.set_ylabel("return of a session, validation")
    axes.legend()


def _triples(axes: "Axes", rows: _Rows) -> None:
    named = list(grouped(rows, lambda row: row.method).items())[::-1]
    shown = zip(DISTRACTOR_RATES, DISTRACTOR_NAMES, (PLAIN, OURS, LIGHT), strict=True)
    for place, (rate, label, color) in enumerate(shown):
        earned = [
            summary(row.value for row in own if row.conditions["distractor"] == rate)
            for _, own in named
        ]
        at = np.arange(len(named)) + 0.25 * (1 - place)
        axes.barh(at, [found.mean for found in earned], height=0.25, color=color, label=label)
    axes.set_yticks(range(len(named)), [name for name, _ in named])
    axes.set_xlabel("return of a session (mean over training seeds)")
    axes.legend()


def _by_world(
    kind: str, draw: Callable[["Axes", _Rows], None], rows: _Rows, folder: Path
) -> list[Path]:
    worlds = grouped(of_checkpoint(rows, "best"), lambda row: row.world)
    return [
        path
        for world, own in worlds.items()
        for path in _saved(folder, f"{kind}-{world}", draw, own)
    ]


@styled
def _saved(
    folder: Path, name: str, draw: Callable[["Axes", _Rows], None], rows: _Rows
) -> list[Path]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.2))
    axes = figure.add_subplot()
    axes.set_title(name)
    draw(axes, rows)
    return save(figure, folder, name)
