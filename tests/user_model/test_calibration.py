"""Scores of simulated users become rewards: on all rows, on halves, and as if all were shown."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.run import training_views
from ucfrec.user_model.calibration import UserCalibration
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import fit_item_reward_model, reward_model_sizes

USERS, LENGTH = 300, 20


def test_calibration_undoes_a_stretched_and_shifted_score(tmp_path: Path) -> None:
    train, validation = training_views(tagged_store(tmp_path))
    model, _ = fit_item_reward_model(train, validation, tmp_path / "model", 0)
    slope, intercept = UserCalibration.fit(model, train, 10_000, 0).line
    for name in ("item", "user", "state", "affinity", "interaction", "exposure"):
        model.get_buffer(name).mul_(2)
    model.item.add_(1)
    again = UserCalibration.fit(model, train, 10_000, 0).line
    assert again[0] == pytest.approx(slope / 2, rel=1e-3)
    assert again[1] == pytest.approx(intercept - slope / 2, abs=1e-3)


def log_of(told: bool, off: float = 0.0) -> EpisodeStore:
    """A log whose policy shows item 0 mostly to users who like it (odds 3 : 1, else 1 : 3).

    Args:
        told: whether the log has propensities.
        off: added to the chance of a like by users of odd numbers.
    """
    rng = np.random.default_rng(0)
    likes = rng.random((USERS, LENGTH)) < 0.5
    first = np.where(likes, 0.9, 0.1)
    items = (rng.random(likes.shape) >= first).astype(np.int64)
    chance = np.where(items == 1, 0.5, np.where(likes, 0.75, 0.25)) + off * (
        np.arange(USERS)[:, None] % 2
    )
    columns = {"item": items.ravel(), "reward": (rng.random(likes.shape) < chance).ravel() * 1.0}
    if told:
        columns["propensity"] = np.where(items == 0, first, 1 - first).ravel()
    states = ItemStates(torch.eye(2), torch.zeros(USERS, 0), 0.0, 1.0)
    episodes = {"user": np.arange(USERS)}
    return EpisodeStore.from_arrays(columns, np.full(USERS, LENGTH), episodes, states)


def even(store: EpisodeStore) -> ItemRewardModel:
    """A model to which items differ by 2 in log-odds."""
    model = ItemRewardModel(reward_model_sizes(store))
    model.binary.fill_(True)
    model.item.copy_(torch.tensor([1.0, -1.0]))
    return model.eval()


@pytest.mark.parametrize("told", [True, False])
def test_with_propensities_items_are_worth_what_they_are_to_anyone(told: bool) -> None:
    store = log_of(told)
    found = UserCalibration.fit(even(store), store, 10**6, 0)
    slope, intercept = found.line
    chances = [1 / (1 + np.exp(-(slope * score + intercept))) for score in (1.0, -1.0)]
    assert found.weighted is told
    assert chances == pytest.approx([0.5 if told else 0.7, 0.5], abs=0.05)
    assert abs(found.optimism) < 3 * found.optimism_error < 0.1


def test_optimism_is_what_one_half_expects_too_much_of_the_other() -> None:
    store = log_of(told=False, off=0.2)
    found = UserCalibration.fit(even(store), store, 10**6, 0)
    intercepts = [line[1] for line in found.halves]
    assert intercepts[1] - intercepts[0] > 0.5
    assert found.optimism_error < 0.1
