"""Means and spreads, checked against numbers worked out on paper."""

import math

import numpy as np
import pytest

from ucfrec.results.statistics import grouped, summary


def test_the_spread_is_that_of_a_sample() -> None:
    found = summary([1.0, 2.0, 6.0])
    # Squares 4, 1, 9 over n − 1.
    assert (found.mean, found.sd, found.count) == (3.0, pytest.approx(math.sqrt(7)), 3)
    assert found.standard_error == pytest.approx(math.sqrt(7 / 3))
    one, none = summary([4.0]), summary([])
    assert (one.mean, one.count, none.count) == (4.0, 1, 0)
    assert np.isnan([none.mean, none.standard_error, one.sd, one.standard_error]).all()


def test_groups_keep_the_order_in_which_they_come() -> None:
    groups = list(grouped("bAaBc", str.lower).items())
    assert groups == [("b", ["b", "B"]), ("a", ["A", "a"]), ("c", ["c"])]
