"""Charts are SVG of a page: text stays text, colors are the page's, and names are never markup."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from tests.support.report_page import HOSTILE
from ucfrec.results.charts import Chart, Interval, interval_chart, line_chart, save

COLORS = ("ink", "soft", "rule", "paper", "c0", "c1")
VALUES = st.floats(-1e6, 1e6, allow_subnormal=False).map(lambda x: round(x, 4))


def charts_of(name: str) -> list[Chart]:
    return [
        line_chart("t", name[:20], [(name, 9, {1.0: 2.0, 20_000.0: 3.5})]),
        interval_chart("t", [Interval(name, 1.0, 2.0, 3.0), Interval("b", -1.0, -2.0, 0.5)]),
        interval_chart("t", [Interval(name, 1.25, 0.0, 3.0, False)], (name, 0.5)),
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
    line, rules, grey = charts_of("ucf")
    assert line.summary == "ucf: 2 at 1, 3.5 at 20000, lowest 2 at 1"
    assert "20k" in "".join(ElementTree.fromstring(line.svg).itertext())
    assert rules.summary == "ucf: 1 [2, 3]. b: -1 [-2, 0.5]"
    assert 'role="img" aria-label="t. ucf' in rules.svg
    # Of a value that cannot be relied on, no number is drawn or said.
    assert grey.summary == "ucf: the data cannot say. For comparison, ucf: 0.5"
    assert "1.25" not in grey.svg
    assert "fill: var(--rule)" in grey.svg
    assert "var(--c0)" not in grey.svg
    assert interval_chart("t", []).summary == ""


@settings(max_examples=6, deadline=None)
@given(st.dictionaries(st.integers(1, 10**7).map(float), VALUES, min_size=1, max_size=9))
def test_any_curve_and_any_intervals_are_drawn(curve: dict[float, float]) -> None:
    assert "<path" in line_chart("t", "x", [("run", 0, curve)]).svg
    intervals = [Interval(f"{name:g}", y, y - 1, y + 1) for name, y in curve.items()]
    assert interval_chart("t", intervals).svg.count("<text") >= len(curve)


@pytest.mark.parametrize("name", ["scores-../../outside", "returns-hopper/mine-v0", "a\\b\n:c"])
def test_a_name_does_not_lead_out_of_the_folder(name: str, tmp_path: Path) -> None:
    files = save(Figure(), tmp_path / "figures", name)
    assert {file.suffix for file in files} == {".png", ".svg"}
    assert {file.parent for file in files} == {tmp_path / "figures"}
    assert sorted(tmp_path.rglob("*.*")) == sorted(files)
