"""Charts are SVG of a page: text stays text, colors are the page's, and names are never markup."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from tests.support.report_page import HOSTILE
from ucfrec.reporting.charts import (
    Chart,
    Interval,
    histogram,
    interval_chart,
    line_chart,
    name_bins,
    save,
)

COLORS = ("ink", "soft", "rule", "paper", "c0", "c1")
VALUES = st.floats(-1e6, 1e6, allow_subnormal=False).map(lambda x: round(x, 4))


def charts_of(name: str) -> list[Chart]:
    return [
        line_chart("t", name[:20], [(name, 9, {1.0: 2.0, 20_000.0: 3.5})], {name: 2.5, "b": 2.5}),
        interval_chart("t", [Interval(name, 1.0, 2.0, 3.0), Interval("b", -1.0, -2.0, 0.5)]),
        interval_chart("t", [Interval(name, 1.0, 0.0, 3.0, False)], logged=0.5),
        histogram("t", name[:20], [3, 0, 1], name_bins([0, 1, 2, 4], None)),
    ]


@pytest.mark.parametrize("name", [HOSTILE, "$x$ \udc80 漢 \x00", "#0100fe", "long name " * 20, ""])
def test_names_are_text_and_the_same_chart_gives_the_same_bytes(name: str) -> None:
    for chart, again in zip(charts_of(name), charts_of(name), strict=True):
        assert chart == again
        elements = list(ElementTree.fromstring(chart.svg).iter())
        tags = "svg g path text tspan use defs clipPath rect"
        assert {element.tag for element in elements} <= set(tags.split())
        attributes = [pair for element in elements for pair in element.items()]
        assert not [key for key, _ in attributes if key.startswith("on")]
        assert all(value[0] == "#" for key, value in attributes if key == "href")
        used = re.findall(r"(?:fill|stroke): ([^;\"]+)", chart.svg)
        assert set(used) <= {"none", *(f"var(--{color})" for color in COLORS)}
        assert "http" not in chart.svg
        assert chart.svg.encode("utf-8")


def test_the_text_says_what_is_drawn() -> None:
    line, bars, forest, columns = charts_of("ucf")
    assert "ucf: 2 at 1, 3.5 at 20000, lowest 2 at 1. For comparison, ucf: 2.5" in line.summary
    assert "20k" in "".join(ElementTree.fromstring(line.svg).itertext())
    assert "ucf: 1, 95% interval 2 to 3. b: -1, 95% interval -2 to 0.5" in bars.summary
    assert forest.summary.endswith("do not rely on it. For comparison, logged sessions: 0.5")
    assert "stroke-dasharray" in forest.svg
    assert columns.summary == "3 columns from 0 to <1 to 2 to <4; the highest is 0 to <1: 3"
    assert 'role="img" aria-label="t. ucf' in bars.svg
    assert interval_chart("t", []).summary == ""


@settings(max_examples=6, deadline=None)
@given(st.dictionaries(st.integers(1, 10**7).map(float), VALUES, min_size=1, max_size=9))
def test_any_curve_and_any_counts_are_drawn(curve: dict[float, float]) -> None:
    assert "<path" in line_chart("t", "x", [("run", 0, curve)]).svg
    counts = [abs(value) for value in curve.values()]
    values = name_bins(None, list(curve))
    assert f"{max(counts):,.6g}" in histogram("t", "x", counts, values).summary


@pytest.mark.parametrize("name", ["scores-../../outside", "returns-hopper/mine-v0", "a\\b\n:c"])
def test_a_name_does_not_lead_out_of_the_folder(name: str, tmp_path: Path) -> None:
    files = save(Figure(), tmp_path / "figures", name)
    assert {file.suffix for file in files} == {".png", ".svg"}
    assert {file.parent for file in files} == {tmp_path / "figures"}
    assert sorted(tmp_path.rglob("*.*")) == sorted(files)
