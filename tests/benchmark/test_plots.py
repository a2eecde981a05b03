"""Pictures of the benchmarks show what their tables say."""

from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from tests.support.result_rows import distractor_rows, result_row
from ucfrec.benchmark import plots
from ucfrec.benchmark.plots import plot_distractor, plot_methods
from ucfrec.benchmark.tables import DISTRACTOR_RATES


def test_pictures_show_the_means_and_the_spread_of_the_tables(tmp_path: Path) -> None:
    values = dict.fromkeys(DISTRACTOR_RATES, (1.0, 2.0))
    rows = [replace(r, method=m) for m in ("dt", "ucf") for r in distractor_rows(values)]
    clean = [row for row in rows if row.conditions["distractor"] is None]
    for plot, given, name in (
        (plot_methods, clean, "methods-w"),
        (plot_distractor, rows, "distractor-w"),
    ):
        made = plot(given, tmp_path)
        assert made == [tmp_path / f"{name}.png", tmp_path / f"{name}.svg"]
        drawn = made[1].read_text()
        assert ">ucf<" in drawn
        assert ">dt<" in drawn
        plot(given, tmp_path)
        assert made[1].read_text() == drawn
    assert plot_distractor(clean, tmp_path) == []


def test_error_bars_are_those_of_the_tables() -> None:
    figure = Figure()
    axes = figure.add_subplot()
    plots._bars(axes, [result_row(value, training_seed=s) for s, value in enumerate((1.0, 3.0))])
    (spread,) = (c.errorbar[2][0] for c in axes.containers if getattr(c, "errorbar", None))
    ((left, right),) = (segment[:, 0] for segment in spread.get_segments())
    assert (right - left) / 2 == pytest.approx(2**0.5)
