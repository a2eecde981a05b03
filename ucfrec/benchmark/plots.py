"""Plots of result rows."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ucfrec.benchmark.tables import DISTRACTOR_RATES, select_checkpoint
from ucfrec.reporting.charts import LIGHT, OURS, PLAIN, save, styled
from ucfrec.results.rows import ResultRow
from ucfrec.results.statistics import grouped, summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DISTRACTOR_NAMES: Final = ("no distractor", "distractor off", "distractor on")
_Rows = Sequence[ResultRow]


def plot_methods(rows: _Rows, folder: Path, kind: str = "methods") -> list[Path]:
    """One plot per environment: return of every method, mean and standard deviation over seeds.

    Args:
        kind: what the files are called, before the environment.
    """
    return _plot_environments(kind, _bars, rows, folder)


def plot_distractor(rows: _Rows, folder: Path) -> list[Path]:
    """One plot per environment with a distractor: returns without it, with it off, and with it on.

    Only rows whose target return is the largest training return are shown.
    """
    rows = [row for row in rows if row.conditions["quantiles"] == "1"]
    planted = {row.environment for row in rows if row.conditions["distractor"] is not None}
    return _plot_environments(
        "distractor", _triples, [r for r in rows if r.environment in planted], folder
    )


def _bars(axes: "Axes", rows: _Rows) -> None:
    by_method = list(grouped(rows, lambda row: row.method).items())[::-1]
    returns = [summary(row.value for row in group) for _, group in by_method]
    colors = [OURS if name == "ucf" else PLAIN for name, _ in by_method]
    means, spreads = [r.mean for r in returns], [r.sd for r in returns]
    axes.barh([name for name, _ in by_method], means, xerr=spreads, color=colors, height=0.7)
    axes.set_xlabel("return per session (mean ± sd over training seeds)")


def _triples(axes: "Axes", rows: _Rows) -> None:
    by_method = list(grouped(rows, lambda row: row.method).items())[::-1]
    conditions = zip(DISTRACTOR_RATES, DISTRACTOR_NAMES, (PLAIN, OURS, LIGHT), strict=True)
    for index, (rate, label, color) in enumerate(conditions):
        returns = [
            summary(row.value for row in group if row.conditions["distractor"] == rate)
            for _, group in by_method
        ]
        positions = np.arange(len(by_method)) + 0.25 * (1 - index)
        means = [r.mean for r in returns]
        axes.barh(positions, means, height=0.25, color=color, label=label)
    axes.set_yticks(range(len(by_method)), [name for name, _ in by_method])
    axes.set_xlabel("return per session (mean over training seeds)")
    axes.legend()


def _plot_environments(
    kind: str, draw: Callable[["Axes", _Rows], None], rows: _Rows, folder: Path
) -> list[Path]:
    environments = grouped(select_checkpoint(rows, "best"), lambda row: row.environment)
    return [
        path
        for environment, group in environments.items()
        for path in _plot(folder, f"{kind}-{environment}", draw, group)
    ]


@styled
def _plot(
    folder: Path, name: str, draw: Callable[["Axes", _Rows], None], rows: _Rows
) -> list[Path]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.2))
    axes = figure.add_subplot()
    axes.set_title(name)
    draw(axes, rows)
    return save(figure, folder, name)
