"""Training users stand for new ones: their tastes are found, also in logs of who knew them."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.support.tagged import tagged_store
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import save_tensors
from ucfrec.runs.run import training_views
from ucfrec.user_model.reward import LAGS, ItemRewardModel
from ucfrec.user_model.reward_fit import (
    fit_item_reward_model,
    fit_training_users,
    reward_model_sizes,
    score_unseen,
)
from ucfrec.user_model.reward_report import RewardRows, calibrate, weigh_by_propensity

USERS, LENGTH, ITEMS, KINDS = 250, 40, 20, 5
LIKED, OTHER = 0.8, 0.1
HALF = ITEMS // 2


def log_of_tastes() -> tuple[EpisodeStore, IntArray]:
    """Sessions of users who like one of five kinds of items, shown at random; and the kinds."""
    rng = np.random.default_rng(0)
    kind = rng.integers(KINDS, size=USERS)
    items = rng.integers(ITEMS, size=(USERS, LENGTH))
    chance = np.where(items % KINDS == kind[:, None], LIKED, OTHER)
    rewards = rng.random(items.shape) < chance
    return store_of(items, rewards, np.full(items.shape, 1 / ITEMS)), kind


def log_of_moods(knowing: float, told: bool = True) -> EpisodeStore:
    """Sessions in half of whose steps everything is liked. In a share `knowing` of the steps the
    log's policy knows this, and shows one of the first ten items then, else one of the others."""
    rng = np.random.default_rng(1)
    mood = rng.random((USERS, LENGTH)) < 0.5
    by_mood = rng.integers(HALF, size=mood.shape) + np.where(mood, 0, HALF)
    acts = rng.random(mood.shape) < knowing
    items = np.where(acts, by_mood, rng.integers(ITEMS, size=mood.shape))
    right = np.where((items < HALF) == mood, knowing / HALF, 0) + (1 - knowing) / ITEMS
    rewards = rng.random(mood.shape) < np.where(mood, LIKED, OTHER)
    return store_of(items, rewards, right if told else None)


def store_of(
    items: IntArray, rewards: BoolArray, right: Float64Array | None, seen: BoolArray | None = None
) -> EpisodeStore:
    """A store of what (USERS, LENGTH) was shown, with `right` propensities and what was `seen`."""
    columns: dict[str, Any] = {"item": items.ravel(), "reward": rewards.ravel() * 1.0}
    if right is not None:
        columns["propensity"] = right.ravel()
    if seen is not None:
        columns["observation"] = seen.reshape(-1, 1).astype(np.float32)
    kinds = torch.eye(KINDS)[torch.arange(ITEMS) % KINDS]
    states = ItemStates(kinds, torch.zeros(USERS, 0), 0.0, 1.0)
    episodes = {"user": np.arange(USERS)}
    return EpisodeStore.from_arrays(columns, np.full(USERS, LENGTH), episodes, states)


def chances(users: Any, rows: RewardRows) -> Float64Array:
    """(M,) the calibrated chances that users like what is shown in the rows."""
    slope, intercept = users[1].calibration
    scores = users[0].score(rows.states, rows.history, rows.users, rows.items)
    return torch.sigmoid(slope * scores + intercept).double().numpy()


def test_tastes_are_found(tmp_path: Path) -> None:
    train, kind = log_of_tastes()
    users = fit_training_users(train, tmp_path, seed=0)
    rows = RewardRows.at(train, *train.all_steps(), LAGS)
    liked = rows.items.numpy() % KINDS == kind[rows.users.numpy()]
    found = chances(users, rows)
    assert "affinity" in {tried.effect for tried in users[1].effects if tried.kept}
    assert found[liked].mean() == pytest.approx(LIKED, abs=0.15)
    assert found[~liked].mean() == pytest.approx(OTHER, abs=0.05)


def test_what_the_logs_policy_knew_makes_no_item_look_better(tmp_path: Path) -> None:
    anything = log_of_moods(knowing=0.0)
    rows = RewardRows.at(anything, *anything.all_steps(), LAGS)
    first = rows.items.numpy() < HALF
    users = fit_training_users(log_of_moods(0.7), tmp_path / "weighted", seed=0)
    crude = fit_training_users(log_of_moods(0.7, told=False), tmp_path / "crude", seed=0)
    found, without = chances(users, rows), chances(crude, rows)
    assert without[first].mean() - without[~first].mean() > 0.3
    assert abs(found[first].mean() - found[~first].mean()) < 0.1
    assert found.mean() == pytest.approx((LIKED + OTHER) / 2, abs=0.05)


def test_of_states_only_observations_and_features_of_users_count(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    items, seen = rng.integers(ITEMS, size=(USERS, LENGTH)), rng.random((USERS, LENGTH)) < 0.5
    rewards = rng.random(seen.shape) < np.where(seen, LIKED, OTHER)
    train = store_of(items, rewards, None, seen)
    users = fit_training_users(train, tmp_path, seed=0)
    found = chances(users, RewardRows.at(train, *train.all_steps(), LAGS))
    assert found[seen.ravel()].mean() == pytest.approx(LIKED, abs=0.03)
    assert found[~seen.ravel()].mean() == pytest.approx(OTHER, abs=0.03)
    states, nothing = torch.randn(3, train.state_size), torch.zeros(3, KINDS + 1)
    level = users[0].level(states, None, nothing)
    states[:, : train.item_states.size] += 1
    assert torch.equal(level, users[0].level(states, None, nothing))


@pytest.mark.parametrize("weighted", [True, False])
def test_no_step_is_expected_by_its_own_reward(tmp_path: Path, weighted: bool) -> None:
    train = log_of_moods(knowing=0.7)
    model, report = fit_training_users(train, tmp_path, 0, weighted)
    _, scores = score_unseen(model, report.effects, weighted, train)
    rewards, last = train.column("reward").copy(), LENGTH - 1
    rewards[last] = 1 - rewards[last]
    items, propensities = (train.column(name) for name in ("item", "propensity"))
    shape = USERS, LENGTH
    other = store_of(items.reshape(shape), rewards.reshape(shape) > 0, propensities.reshape(shape))
    changed = (score_unseen(model, report.effects, weighted, other)[1] != scores).numpy()
    assert not changed[last]
    assert changed.mean() > 0.7


def test_a_file_with_another_report_is_named(tmp_path: Path) -> None:
    train, file = log_of_tastes()[0], tmp_path / "training_users.safetensors"
    users = fit_training_users(train, tmp_path, seed=0)
    report = dataclasses.asdict(users[1])
    for other in ({}, {**report, "calibration": 1.0}, {**report, "more": 1}):
        save_tensors(file, users[0].state_dict(), other)
        with pytest.raises(InputError, match="damaged"):
            fit_training_users(train, tmp_path, seed=0)


@given(
    st.lists(st.sampled_from([0.01, 0.05, 0.2, 0.5, 1.0]), min_size=8, max_size=8),
    st.integers(2, 50),
)
def test_weights_add_up_to_a_users_effective_steps(propensities: list[float], items: int) -> None:
    logged, zeros = np.array(propensities), np.zeros(8)
    columns = {"item": zeros.astype(np.int64), "reward": zeros, "propensity": logged}
    states = ItemStates(torch.ones(1, 2), torch.zeros(2, 0), 0.0, 1.0)
    users = np.array([1, 0, 1])
    view = EpisodeStore.from_arrays(columns, np.array([3, 4, 1]), {"user": users}, states)
    weights = weigh_by_propensity(view, *view.all_steps(), items)
    assert weights is not None
    shares = np.minimum(10.0, 1 / (np.float32(logged) * items))
    for user in (0, 1):
        of_user = np.repeat(users, [3, 4, 1]) == user
        found, expected = weights.double().numpy()[of_user], shares[of_user]
        assert np.allclose(found / found.max(), expected / expected.max(), rtol=1e-5)
        effective = expected.sum() ** 2 / np.square(expected).sum()
        assert found.sum() == pytest.approx(effective, rel=1e-4)
    # Not if one is missing.
    columns["propensity"] = np.where(np.arange(8) == 3, np.nan, logged)
    view = EpisodeStore.from_arrays(columns, np.array([3, 4, 1]), {"user": users}, states)
    assert weigh_by_propensity(view, *view.all_steps(), items) is None


MANY_USERS, FEW_STEPS = 300, 20


def test_calibration_undoes_a_stretched_and_shifted_score(tmp_path: Path) -> None:
    train, validation = training_views(tagged_store(tmp_path))
    model, _ = fit_item_reward_model(train, validation, tmp_path / "model", 0)
    slope, intercept = calibrate(model, train, 10_000, 0)
    effects = "item", "user", "state", "affinity", "interaction", "exposure", "interests.weights"
    for name in effects:
        model.get_buffer(name).mul_(2)
    model.item.add_(1)
    again = calibrate(model, train, 10_000, 0)
    assert again[0] == pytest.approx(slope / 2, rel=2e-3)
    assert again[1] == pytest.approx(intercept - slope / 2, abs=1e-3)


def log_of(told: bool) -> EpisodeStore:
    """A log whose policy shows item 0 mostly to users who like it (3 : 1, else 1 : 3)."""
    rng = np.random.default_rng(0)
    likes = rng.random((MANY_USERS, FEW_STEPS)) < 0.5
    first = np.where(likes, 0.9, 0.1)
    items = (rng.random(likes.shape) >= first).astype(np.int64)
    chance = np.where(items == 1, 0.5, np.where(likes, 0.75, 0.25))
    columns = {"item": items.ravel(), "reward": (rng.random(likes.shape) < chance).ravel() * 1.0}
    if told:
        columns["propensity"] = np.where(items == 0, first, 1 - first).ravel()
    states = ItemStates(torch.eye(2), torch.zeros(MANY_USERS, 0), 0.0, 1.0)
    episodes = {"user": np.arange(MANY_USERS)}
    return EpisodeStore.from_arrays(columns, np.full(MANY_USERS, FEW_STEPS), episodes, states)


def even(store: EpisodeStore) -> ItemRewardModel:
    """A model to which items differ by 2 in log-odds."""
    model = ItemRewardModel(reward_model_sizes(store))
    model.binary.fill_(True)
    model.item.copy_(torch.tensor([1.0, -1.0]))
    return model.eval()


@pytest.mark.parametrize("told", [True, False])
def test_with_propensities_items_are_worth_what_they_are_to_anyone(told: bool) -> None:
    store = log_of(told)
    slope, intercept = calibrate(even(store), store, 10**6, 0)
    chances = [1 / (1 + np.exp(-(slope * score + intercept))) for score in (1.0, -1.0)]
    assert chances == pytest.approx([0.5 if told else 0.7, 0.5], abs=0.05)
