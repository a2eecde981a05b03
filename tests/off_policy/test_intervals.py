"""Cluster bootstrap: coverage, users, heavy weights, and where nothing spreads."""

import numpy as np
import pytest

from ucfrec.off_policy.intervals import MOST_CLUSTERS, cluster_intervals, cluster_mean


def column(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, dtype=np.float64)[:, None]


def covers(interval: object, truth: float) -> bool:
    return interval is not None and interval.low <= truth <= interval.high  # type: ignore[attr-defined]


def test_sessions_of_one_user_are_resampled_together() -> None:
    """Users of 20 sessions each, taste far more different between than within them."""
    together = apart = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        taste = np.repeat(rng.normal(size=40), 20)
        values, ones = column(taste + 0.5 * rng.normal(size=800)), np.ones((800, 1))
        users = np.repeat(rng.permutation(40), 20)
        together += covers(cluster_intervals(values, ones, users, seed)[0], 0.0)
        apart += covers(cluster_intervals(values, ones, None, seed)[0], 0.0)
    assert together >= 26
    assert apart <= 15


def test_heavy_weights_are_covered_as_the_percentile_interval_does_not() -> None:
    studentised = percentile = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        weights = rng.lognormal(sigma=1.2, size=200) / np.exp(0.72)
        (interval,) = cluster_intervals(column(weights), np.ones((200, 1)), None, seed)
        studentised += covers(interval, 1.0)
        means = rng.choice(weights, (1000, 200)).mean(axis=1)
        low, high = np.quantile(means, [0.025, 0.975])
        percentile += bool(low <= 1 <= high)
    assert studentised >= 90
    assert studentised > percentile


def test_ratios_and_columns_are_independent_of_each_other() -> None:
    rng = np.random.default_rng(0)
    above, below = rng.normal(size=(50, 2)), rng.uniform(1, 2, (50, 2))
    both = cluster_intervals(above, below, None, seed=3)
    for k in range(2):
        (alone,) = cluster_intervals(above[:, [k]], below[:, [k]], None, seed=3)
        assert both[k] is not None
        assert vars(both[k]) == pytest.approx(vars(alone))
    # Scales neither overflow nor change anything but the unit.
    huge = cluster_intervals(above * 1e100, below, None, seed=3)
    assert huge[0] is not None
    assert huge[0].low == pytest.approx(both[0].low * 1e100)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("values", "users"),
    [
        (np.zeros(50), None),
        (np.ones(50), None),
        (np.arange(50), np.zeros(50, dtype=np.int64)),
        (np.eye(1, 50)[0], None),
    ],
)
def test_where_nothing_spreads_there_is_no_interval(
    values: np.ndarray, users: np.ndarray | None
) -> None:
    assert cluster_intervals(column(values), np.ones((50, 1)), users, 0) == [None]


def test_more_clusters_than_are_drawn_from_change_no_error() -> None:
    values = column(np.random.default_rng(0).exponential(size=3 * MOST_CLUSTERS))
    (interval,) = cluster_intervals(values, np.ones_like(values), None, seed=0)
    assert interval is not None
    expected = values.std() / len(values) ** 0.5
    assert interval.error == pytest.approx(expected, rel=0.03)
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * expected, rel=0.08)


def test_means_have_clustered_errors() -> None:
    values = np.repeat([0.0, 1.0, 5.0], 4)
    mean, error = cluster_mean(values, np.repeat([7, 3, 9], 4))
    assert mean == pytest.approx(2.0)
    assert error == pytest.approx(np.std([0, 1, 5], ddof=1) / 3**0.5)
    weights = np.repeat([1.0, 1.0, 0.0], 4)
    assert cluster_mean(values, np.repeat([7, 3, 9], 4), weights)[0] == pytest.approx(0.5)
