"""Estimated propensities where the logging policy is known."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from ucfrec.arrays import Float32Array, Float64Array, IntArray
from ucfrec.off_policy import LoggedSteps, estimate
from ucfrec.off_policy.behavior_model import (
    BehaviorModel,
    fit_behavior,
    group_items,
)

GROUP_OF = np.array([0, 0, 0, 1, 1, 2, 2, 2, 2])
STEPS = 6000


def behavior() -> tuple[Float32Array, Float64Array]:
    """States (N, 3), and the probability (N, 9) of every item: groups by the state, items of a
    group alike but for the first, which is shown twice as often."""
    rng = np.random.default_rng(0)
    states = rng.normal(size=(STEPS, 3)).astype(np.float32)
    logits = 0.5 * states @ rng.normal(size=(3, 3))
    groups = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    share = np.array([2, 1, 1, 2, 1, 2, 1, 1, 1])
    share = share / np.bincount(GROUP_OF, share)[GROUP_OF]
    return states, groups[:, GROUP_OF] * share


def logged() -> tuple[Float32Array, Float64Array, IntArray, BehaviorModel]:
    states, probabilities = behavior()
    rng = np.random.default_rng(1)
    item = (rng.random((STEPS, 1)) > probabilities.cumsum(axis=1)).sum(axis=1).clip(0, 8)

    def chunks() -> Iterator[Float32Array]:
        yield from np.array_split(states, 7)

    session = np.arange(STEPS)
    model = fit_behavior(chunks, item, GROUP_OF[item], session, 0, session // 4)
    return states, probabilities, item, model


def test_probabilities_are_those_of_the_logging_policy() -> None:
    _, probabilities, item, model = logged()
    true = probabilities[np.arange(STEPS), item]
    groups = np.stack([probabilities[:, group == GROUP_OF].sum(axis=1) for group in range(3)])
    of_group = groups[GROUP_OF[item], np.arange(STEPS)]
    assert np.corrcoef(model.item, true)[0, 1] > 0.97
    assert np.abs(model.group - of_group).mean() < 0.03
    assert model.log_loss < model.share_log_loss - 0.1
    assert model.calibration_error < 0.05
    assert "held-out loss" in str(model)


def test_estimated_propensities_find_the_value_that_the_logged_mean_misses() -> None:
    states, probabilities, item, model = logged()
    pays = np.linspace(0.1, 0.9, 9)
    wish = (1 + states[:, [0]]) * np.linspace(-1, 1, 9)
    target = np.exp(wish) / np.exp(wish).sum(axis=1, keepdims=True)
    truth = float((target * pays).sum(axis=1).mean())
    rng = np.random.default_rng(2)
    steps = LoggedSteps(
        np.arange(STEPS),
        (rng.random(STEPS) < pays[item]).astype(np.float64),
        model.item,
        target[np.arange(STEPS), item],
    )
    one = estimate(steps, 0)["SNIPS"]
    assert abs(steps.reward.mean() - truth) > 0.1
    assert one.value == pytest.approx(truth, abs=0.03)
    known = replace(steps, propensity=probabilities[np.arange(STEPS), item])
    assert one.value == pytest.approx(estimate(known, 0)["SNIPS"].value, abs=0.03)


def test_users_are_predicted_by_models_of_others() -> None:
    """What one user does changes nothing of what is said of that user."""
    states, _ = behavior()
    session = np.arange(STEPS)
    item = np.random.default_rng(3).integers(9, size=STEPS)
    changed = np.where(session // 4 == 11, 0, item)
    same = (item == changed) & (session // 4 == 11)
    models = [
        fit_behavior(lambda: iter([states]), one, GROUP_OF[one], session, 0, session // 4)
        for one in (item, changed)
    ]
    if (models[0].temperature, models[0].share) == (models[1].temperature, models[1].share):
        np.testing.assert_array_equal(models[0].item[same], models[1].item[same])


def test_unknown_items_are_left_alone() -> None:
    states, _ = behavior()
    item = np.where(np.arange(STEPS) % 5 == 0, -1, np.arange(STEPS) % 9)
    model = fit_behavior(
        lambda: iter([states]), item, GROUP_OF[np.maximum(item, 0)], np.arange(STEPS), 0
    )
    assert (model.item[item < 0] == 1).all()
    # Items do not follow the state: each of nine, whatever it is.
    np.testing.assert_allclose(model.item[item >= 0], 1 / 9, rtol=0.1)
    assert model.share == 1


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_one_user_with_known_items_is_predicted_by_equal_shares() -> None:
    states, item = behavior()[0][:80], np.arange(80) % 9
    item[40:] = -1
    session = np.arange(80) // 40
    model = fit_behavior(lambda: iter([states]), item, GROUP_OF[item], session, 0)
    np.testing.assert_allclose(model.group[:40], 1 / 3)
    np.testing.assert_array_equal(model.group[40:], 1.0)


def test_one_group_is_certain() -> None:
    states, _ = behavior()
    item = np.arange(STEPS) % 9
    model = fit_behavior(
        lambda: iter([states]), item, np.zeros(STEPS, dtype=np.int64), np.arange(STEPS), 0
    )
    np.testing.assert_allclose(model.group, 1)
    np.testing.assert_allclose(model.item, 1 / 9, rtol=0.1)


def test_groups_are_the_clusters_of_embeddings() -> None:
    rng = np.random.default_rng(0)
    centres, true = 10 * rng.normal(size=(4, 8)), rng.integers(4, size=200)
    embeddings = (centres[true] + 0.1 * rng.normal(size=(200, 8))).astype(np.float32)
    found = group_items(embeddings, 4, seed=0)
    assert len(set(zip(true, found, strict=True))) == 4
    assert set(found) == {0, 1, 2, 3}


@pytest.mark.parametrize(("items", "groups"), [(1, 1), (80, 9), (2000, 32)])
def test_their_number_follows_the_catalogue(items: int, groups: int) -> None:
    embeddings = np.random.default_rng(0).normal(size=(items, 2)).astype(np.float32)
    assert group_items(embeddings, 0, seed=0).max() + 1 == groups
    assert not group_items(embeddings, 1, seed=0).any()
