"""Groups of items, their tests, and marginalised weights over them."""

from dataclasses import replace

import numpy as np
import pytest

from ucfrec.errors import InputError
from ucfrec.off_policy import LoggedSteps, diagnose, judge
from ucfrec.off_policy.item_groups import default_groups, group_items
from ucfrec.off_policy.logged_steps import ItemGroups


def test_groups_are_the_clusters_of_embeddings() -> None:
    rng = np.random.default_rng(0)
    centres, true = 10 * rng.normal(size=(4, 8)), rng.integers(4, size=200)
    embeddings = (centres[true] + 0.1 * rng.normal(size=(200, 8))).astype(np.float32)
    found = group_items(embeddings, 4, seed=0)
    assert len(set(zip(true, found, strict=True))) == 4
    assert set(found) == {0, 1, 2, 3}


def test_equal_items_are_one_group() -> None:
    embeddings = np.repeat(np.eye(3, dtype=np.float32), 5, axis=0)
    found = group_items(embeddings, 7, seed=0)
    np.testing.assert_array_equal(found, np.repeat(found[::5], 5))
    assert found.max() == 2


@pytest.mark.parametrize(("items", "groups"), [(1, 2), (80, 9), (7583, 32)])
def test_their_number_follows_the_catalogue(items: int, groups: int) -> None:
    assert default_groups(items) == groups


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
    assert "item group" in str(judge(wrong, seed=0))


def test_a_group_that_the_logs_lack_is_named() -> None:
    behavior, target = np.array([0.5, 0.49, 0.01, 0.0]), np.array([0.4, 0.4, 0.01, 0.19])
    failed = [test for test in diagnose(grouped(behavior, target)).tests if not test.passed]
    assert {"item group 1", "step 1"} <= {test.name for test in failed}


def test_groups_have_a_row_for_each_step() -> None:
    steps = grouped(np.full(4, 0.25), np.full(4, 0.25), sessions=50)
    groups = ItemGroups(np.zeros(49, dtype=np.int64), np.ones((50, 1), dtype=np.float32))
    with pytest.raises(InputError, match="groups have shapes"):
        replace(steps, groups=groups)
    kept = steps.only(np.arange(50) < 10)
    assert kept.groups is not None
    assert len(kept.groups.target) == 10
