"""Data quality: the numbers are those that `prepare` reported, and no others."""

from typing import Any

import pytest

from tests.support.report_page import SOURCE
from ucfrec.episodes.record import Source
from ucfrec.reporting.training import draw_distributions, tabulate_rows


def test_the_numbers_are_those_of_the_report() -> None:
    source = Source.model_validate(SOURCE)
    read, dropped = tabulate_rows(source)
    assert ("rows read", ["1,200"]) in read.rows
    assert ("items", ["9"]) in read.rows
    reasons = {name.partition(":")[0]: cells for name, cells in dropped.rows}
    assert reasons["duplicate"] == ["12", "1.00%"]
    assert reasons["conflicting duplicate"] == ["6", "0.50%"]
    (lengths, rewards, popularity), quantiles = draw_distributions(source)
    assert [name for name, _ in lengths[1].rows] == ["1 to <2", "2 to <4", "4 to <8"]
    assert lengths[1].rows[0][1] == ["4", "50.00%"]
    assert [name for name, _ in rewards[1].rows] == ["0", "1"]
    assert popularity[0].title == "Items by popularity"
    assert quantiles is not None
    assert quantiles.rows[0][1] == ["1", "1", "2", "3", "6.5", "7"]


@pytest.mark.parametrize("source", [{}, {"dataset": "hopper"}])
def test_what_is_not_recorded_is_left_out(source: dict[str, Any]) -> None:
    record = Source.model_validate(source)
    assert tabulate_rows(record) == []
    assert draw_distributions(record) == ([], None)
