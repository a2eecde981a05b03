"""Means and spreads, checked against numbers worked out on paper."""

import math

import pytest

from ucfrec.reporting.statistics import grouped, summary


def test_the_spread_is_that_of_a_sample() -> None:
    found = summary([1.0, 2.0, 6.0])
    # Squares 4, 1, 9 over n − 1.
    assert (found.mean, found.sd, found.count) == (3.0, pytest.approx(math.sqrt(7)), 3)
    assert found.standard_error == pytest.approx(math.sqrt(7 / 3))


def test_too_few_values_have_no_spread() -> None:
    one, none = summary([4.0]), summary([])
    assert (one.mean, one.count) == (4.0, 1)
    assert (none.count, math.isnan(none.mean), math.isnan(none.standard_error)) == (0, True, True)
    assert math.isnan(one.sd)
    assert math.isnan(one.standard_error)


def test_groups_keep_the_order_in_which_they_come() -> None:
    assert list(grouped("bAaBc", str.lower).items()) == [
        ("b", ["b", "B"]),
        ("a", ["A", "a"]),
        ("c", ["c"]),
    ]
