"""Tails and bounds against what is known of them."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.logged_steps import random_steps
from ucfrec.off_policy import LoggedSteps, conclude
from ucfrec.off_policy.diagnostics import (
    diagnose,
    identification_bounds,
    implied_items,
    pareto_tail,
)
from ucfrec.off_policy.logged_steps import ItemGroups


@pytest.mark.parametrize("shape", [0.2, 0.5, 0.9])
def test_the_tail_of_a_pareto_sample_has_its_shape(shape: float) -> None:
    rng = np.random.default_rng(1)
    found = [pareto_tail(rng.pareto(1 / shape, 20_000) + 1) for _ in range(20)]
    assert np.mean([one for one in found if one is not None]) == pytest.approx(shape, abs=0.05)


def test_weights_of_few_values_have_no_tail() -> None:
    assert pareto_tail(np.tile([0.0, 1.0, 3.0], 1000)) is None
    assert pareto_tail(np.ones(5)) is None


def test_effective_users_follow_each_step_of_uneven_sessions() -> None:
    steps = random_steps([1, 4, 2, 3] * 20)
    user = np.arange(80) % 7
    found = diagnose(replace(steps, user=user)).effective_by_step
    for place in range(4):
        weight = np.array(
            [
                steps.weights[first + min(place, length - 1)]
                for first, length in zip(steps.first, steps.lengths, strict=True)
            ]
        )
        by_user = np.bincount(user, weight)
        assert found[place] == pytest.approx(by_user.sum() ** 2 / (by_user**2).sum())


def test_bounds_are_the_estimate_where_nothing_lacks() -> None:
    steps = random_steps([3] * 50)
    whole = replace(steps, target=steps.propensity)
    low, high = identification_bounds(whole, (-1, 1))
    assert low == high == pytest.approx(whole.returns.mean())
    half = replace(steps, target=steps.propensity / 2)
    low, high = identification_bounds(half, (0, 1))
    # Half of the first choices lack, three quarters of the second, seven eighths of the third.
    assert high - low == pytest.approx(0.5 + 0.75 + 0.875)


@pytest.mark.parametrize(("factor", "items"), [(1.0, 20), (0.5, 40), (2.0, 10)])
def test_propensities_imply_how_many_items_there_are(factor: float, items: float) -> None:
    """Whatever the shares of the 20 items are; fewer may be candidates, more cannot."""
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.full(20, 5.0))
    item = rng.choice(20, p=shares, size=20_000)
    steps = random_steps([1] * 20_000)
    steps = replace(steps, propensity=np.minimum(shares[item] * factor, 1))
    found = implied_items(steps, np.ones(20_000, dtype=bool), 20)
    assert found is not None
    assert found.mean * 20 == pytest.approx(items, rel=0.05)
    assert found.passed is (factor >= 1)
    half = implied_items(steps, item < 10, 10)
    assert half is not None
    assert half.mean == pytest.approx(items / 20, rel=0.05)


def test_few_users_and_no_propensities_imply_nothing() -> None:
    steps = random_steps([1] * 50)
    listed = np.ones(50, dtype=bool)
    assert implied_items(replace(steps, user=np.arange(50) % 20), listed, 5) is None
    assert implied_items(replace(steps, propensity=np.full(50, np.nan)), listed, 5) is None


def grouped(behavior: np.ndarray, target: np.ndarray, sessions: int = 8000) -> LoggedSteps:
    """Steps of four items in two groups."""
    items = np.random.default_rng(0).choice(4, p=behavior, size=sessions)
    group_of = np.array([0, 0, 1, 1])
    shares = np.array([target[:2].sum(), target[2:].sum()], dtype=np.float32)
    return LoggedSteps(
        np.arange(sessions),
        (np.random.default_rng(1).random(sessions) < 0.3).astype(np.float64),
        behavior[items],
        target[items],
        groups=ItemGroups(group_of[items], np.tile(shares, (sessions, 1))),
    )


def test_wrong_propensities_of_one_group_are_found() -> None:
    """Too large for one, too small for the other: right on average."""
    target = np.array([0.2, 0.3, 0.3, 0.2])
    steps = grouped(np.full(4, 0.25), target)
    tests = {test.name: test for test in diagnose(steps).tests}
    assert tests["item group 0"].passed
    assert tests["item group 1"].passed
    assert steps.groups is not None
    factor = np.where(steps.groups.number == 0, 1.25, 1 / 1.2)
    twisted = diagnose(replace(steps, propensity=steps.propensity * factor))
    failed = {test.name: test.mean for test in twisted.tests if not test.passed}
    assert set(failed) == {"item group 0", "item group 1"}
    assert failed["item group 0"] == pytest.approx(0.8, abs=0.05)
    assert failed["item group 1"] == pytest.approx(1.2, abs=0.05)
    wrong = replace(steps, propensity=steps.propensity * factor)
    assert "item group" in str(conclude(wrong, seed=0))


def test_a_group_that_the_logs_lack_is_named() -> None:
    behavior, target = np.array([0.5, 0.49, 0.01, 0.0]), np.array([0.4, 0.4, 0.01, 0.19])
    failed = [test for test in diagnose(grouped(behavior, target)).tests if not test.passed]
    assert {"item group 1", "step 1"} <= {test.name for test in failed}


def test_groups_go_with_their_steps() -> None:
    steps = grouped(np.full(4, 0.25), np.full(4, 0.25), sessions=50)
    kept = steps.select(np.arange(50) < 10)
    assert kept.groups is not None
    assert len(kept.groups.target) == 10
