"""Means and spreads, checked against numbers worked out on paper."""

import math

import numpy as np
import pytest
from scipy.stats import rankdata

from ucfrec.results.statistics import average_ranks, group_auc, grouped, ratio_with_error, summary


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


def test_ranks_of_equal_values_are_their_mean() -> None:
    rng = np.random.default_rng(0)
    for values in (rng.integers(5, size=40), rng.normal(size=40), np.array([np.inf, -np.inf, 0.0])):
        np.testing.assert_array_equal(average_ranks(values), rankdata(values))


def test_group_auc_is_the_mean_over_pairs_of_a_user() -> None:
    rng = np.random.default_rng(0)
    owner = rng.integers(6, size=60)
    scores, liked = rng.integers(5, size=60).astype(float), rng.random(60) < 0.4
    liked[owner == 2] = True
    above, below = group_auc(scores, liked, owner, 7)
    for user in range(7):
        good, bad = scores[(owner == user) & liked], scores[(owner == user) & ~liked]
        pairs = [(a > b) + 0.5 * (a == b) for a in good for b in bad]
        size = (owner == user).sum() if pairs else 0
        assert below[user] == size
        assert above[user] == pytest.approx(size * np.mean(pairs) if pairs else 0.0)


def test_the_error_of_a_ratio_is_that_of_resampled_users() -> None:
    rng = np.random.default_rng(1)
    below = rng.integers(1, 20, size=300).astype(float)
    above = below * np.clip(rng.normal(0.6, 0.2, size=300), 0, 1)
    ratio, error = ratio_with_error(above, below)
    drawn = rng.integers(300, size=(2000, 300))
    resampled = above[drawn].sum(1) / below[drawn].sum(1)
    assert ratio == pytest.approx(above.sum() / below.sum())
    assert error == pytest.approx(resampled.std(), rel=0.1)
    assert np.isnan(ratio_with_error(np.zeros(3), np.zeros(3))).all()
