"""Data quality: the numbers are those that `prepare` reported; what it did not report is said."""

from typing import Any

import pytest

from tests.support.report_page import SOURCE
from ucfrec.episodes.record import Source
from ucfrec.reporting.data_quality import data_quality


def test_the_numbers_are_those_of_the_report() -> None:
    quality = data_quality(Source.model_validate(SOURCE))
    assert quality.rows is not None
    assert ("rows read", ["1,200"]) in quality.rows.rows
    assert ("items", ["9"]) in quality.rows.rows
    assert quality.dropped is not None
    dropped = {name.partition(":")[0]: cells for name, cells in quality.dropped.rows}
    assert dropped["duplicate"] == ["12", "1.00%"]
    assert dropped["conflicting duplicate"] == ["6", "0.50%"]
    lengths, rewards, popularity = quality.pictures
    assert [name for name, _ in lengths[1].rows] == ["1 to <2", "2 to <4", "4 to <8"]
    assert lengths[1].rows[0][1] == ["4", "50.00%"]
    assert [name for name, _ in rewards[1].rows] == ["0", "1"]
    assert popularity[0].title == "Items by popularity"
    assert quality.quantiles is not None
    assert quality.quantiles.rows[0][1] == ["1", "1", "2", "3", "6.5", "7"]


@pytest.mark.parametrize("source", [{}, {"dataset": "hopper"}])
def test_what_is_not_recorded_is_left_out(source: dict[str, Any]) -> None:
    quality = data_quality(Source.model_validate(source))
    assert (quality.rows, quality.dropped, quality.quantiles) == (None, None, None)
    assert quality.pictures == []
