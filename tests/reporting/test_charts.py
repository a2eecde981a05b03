"""Charts: everything lies inside the drawing, and stands for its value."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.reporting import charts

VALUES = st.floats(-1e6, 1e6, allow_subnormal=False).map(lambda x: round(x, 4))


@given(st.dictionaries(st.integers(1, 10**7).map(float), VALUES, min_size=1, max_size=30))
def test_every_point_is_drawn_inside_the_axes(curve: dict[float, float]) -> None:
    chart = charts.line_chart("t", "x", [("run", 0, curve)])
    points = [tuple(map(float, p.split(","))) for p in chart.lines[0].points.split()]
    assert len(points) == len(curve) + 1
    for x, y in points:
        assert charts.LEFT <= x <= charts.WIDTH - charts.RIGHT
        assert charts.TOP <= y <= charts.HEIGHT - charts.BOTTOM
    for ticks in (chart.x_ticks, chart.y_ticks):
        assert 2 <= len(ticks) <= 7
        assert len({tick.label for tick in ticks}) == len(ticks)


@given(st.lists(st.tuples(VALUES, st.floats(0, 100), st.floats(0, 100)), min_size=1, max_size=8))
def test_bars_start_at_zero_and_carry_their_interval(
    rows: list[tuple[float, float, float]],
) -> None:
    chart = charts.bar_chart("t", [("p", v, v - below, v + above) for v, below, above in rows])
    for bar, (value, _, _) in zip(chart.bars, rows, strict=True):
        end = bar.end if value >= 0 else bar.start
        assert chart.zero in (bar.start, bar.end)
        assert bar.low <= end <= bar.high
        assert dataclasses.astuple(bar)[2] < chart.height


@given(
    st.dictionaries(st.integers(1, 10**4).map(float), VALUES, min_size=1, max_size=9),
    st.lists(VALUES, min_size=1, max_size=2, unique=True),
)
def test_levels_lie_on_the_axis_of_the_curves(
    curve: dict[float, float], levels: list[float]
) -> None:
    named = {f"level {i}": value for i, value in enumerate(levels)}
    chart = charts.line_chart("t", "x", [("run", 0, curve)], named)
    assert len(chart.levels) == len(levels)
    heights = [float(p.split(",")[1]) for p in chart.lines[0].points.split()][1:]
    known = dict(zip([v for _, v in sorted(curve.items())], heights, strict=True))
    for level, value in zip(chart.levels, sorted(levels, reverse=True), strict=True):
        assert charts.TOP <= level.y <= charts.HEIGHT - charts.BOTTOM
        assert f"{value:.4g}" in level.label
        for other, y in known.items():
            if other > value:
                assert y <= level.y + 0.01
    if len(chart.levels) == 2:  # labels never overlap
        assert abs(chart.levels[0].label_y - chart.levels[1].label_y) >= 10


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=25).filter(any), st.booleans())
def test_columns_are_as_high_as_their_counts(counts: list[int], binned: bool) -> None:
    edges = [float(2**i) for i in range(len(counts) + 1)]
    values = None if binned else edges[:-1]
    chart = charts.histogram("t", "x", counts, edges if binned else None, values)
    floor, highest = charts.HEIGHT - charts.BOTTOM, max(c.height for c in chart.columns)
    for column, count in zip(chart.columns, counts, strict=True):
        assert column.y + column.height == pytest.approx(floor, abs=0.02)
        assert column.y >= charts.TOP
        assert column.height == pytest.approx(count / max(counts) * highest, abs=0.03)
    right = chart.columns[-1].x + chart.columns[-1].width
    assert abs(right - (charts.WIDTH - charts.RIGHT)) < 0.02 * len(counts)
    assert len(chart.x_ticks) <= 6
    assert f"{max(counts):,.6g}" in chart.summary


def test_a_long_name_is_drawn_whole() -> None:
    name = "a policy whose name is longer than any chart is wide, with its seed and its checkpoint"
    chart = charts.bar_chart("t", [(name, 1.0, 0.5, 1.5), ("b", 1.0, 0.5, 1.5)])
    assert " ".join(chart.bars[0].name) == name
    assert chart.bars[0].top + charts.NAME * len(chart.bars[0].name) < chart.bars[0].y
    assert chart.bars[0].y < chart.bars[1].top
