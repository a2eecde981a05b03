"""Result rows in a notebook: a frame, a chart, HTML that quotes names, and a file for `report`."""

from pathlib import Path

import matplotlib as mpl
import pytest

from ucfrec.errors import InputError
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import read_results
from ucfrec.results.table import Measured

mpl.use("Agg")
_KEY = {"suite": "rank", "table": "rank", "task": "logs", "policy": "dt", "metric": "R"}
ROWS = [
    ResultRow(
        **_KEY,
        method="<b>",
        metrics={"R": 1.5, "S": 0.25},
        interval=(1.0, 2.5),
        details={"intervals": {"S": [0.125, 0.5]}},
        conditions={"k": 10},
    ),
    ResultRow(**_KEY, method="popular", metrics={"R": 1.0}, conditions={"k": 10}),
]


def test_a_frame_has_metrics_with_their_intervals() -> None:
    frame = Measured(ROWS).to_frame().set_index("method")
    assert frame.loc["<b>", ["R", "R_low", "R_high", "S", "S_low", "S_high"]].tolist() == [
        *(1.5, 1.0, 2.5),
        *(0.25, 0.125, 0.5),
    ]
    assert frame.loc["popular", ["S", "R_low"]].isna().all()
    assert (frame.k == 10).all()


def test_a_notebook_shows_rows_and_warnings_and_no_markup_of_names() -> None:
    html = Measured(ROWS, ["mind <this>"])._repr_html_()
    assert "&lt;b&gt;" in html
    assert "<b>" not in html
    assert "mind &lt;this&gt;" in html
    shown = repr(Measured(ROWS, ["mind <this>"])).splitlines()
    assert "popular" in shown[-2]
    assert shown[-1] == "warning: mind <this>"


def test_a_chart_has_a_point_and_an_interval_for_each_method() -> None:
    axes = Measured(ROWS).plot()
    assert [label.get_text() for label in axes.get_yticklabels()] == ["popular", "<b>"]
    assert axes.lines[0].get_xdata().tolist() == [1.0, 1.5]  # type: ignore[union-attr]
    again = Measured(ROWS).plot("S", ax=axes)
    assert again is axes
    for name in ("T", "method", "k"):
        with pytest.raises(InputError, match=f"no row has the metric '{name}'; they have R, S"):
            Measured(ROWS).plot(name)


def test_saved_rows_are_read_again(tmp_path: Path) -> None:
    Measured(ROWS).save(tmp_path / "rows.json")
    assert read_results(tmp_path / "rows.json") == ROWS
