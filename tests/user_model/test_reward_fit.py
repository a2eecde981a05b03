"""Fitting the reward model of items: what it recovers, what it reads, and what it reports."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from ucfrec.arrays import Float64Array, IntArray
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.user_model.reward import LAGS, MEMORY, ItemRewardModel
from ucfrec.user_model.reward_effects import fit_effects
from ucfrec.user_model.reward_fit import fit_item_reward_model, refit_item_reward_model
from ucfrec.user_model.reward_report import RewardRows, calibrate, calibration_error, score_rows

ITEMS, USERS, LENGTH, DIM, TAGS = 40, 150, 20, 4, 6


class Log(NamedTuple):
    """A log of one session a user, and what was planted."""

    items: IntArray
    users: IntArray
    predictor: Float64Array
    of_item: Float64Array


def sigmoid(values: Float64Array) -> Float64Array:
    return 1 / (1 + np.exp(-values))


def log(seed: int, boredom: float = 0.0, taste: float = 0.0, users: int = USERS) -> Log:
    """Items shown at random; users and items differ, and may tire of, or like, some tags."""
    rng, environment = np.random.default_rng(seed), np.random.default_rng(99)
    of_item, tags = environment.normal(0, 1, ITEMS), np.arange(ITEMS) % TAGS
    of_user = rng.normal(0, 1, users)
    items = rng.integers(ITEMS, size=(users, LENGTH))
    liked = rng.integers(TAGS, size=users)
    predictor = of_item[items] + of_user[:, None] + taste * (tags[items] == liked[:, None])
    repeats = tags[items][:, 1:] == tags[items][:, :-1]
    predictor[:, 1:] -= boredom * repeats
    return Log(items.ravel(), np.repeat(np.arange(users), LENGTH), predictor.ravel(), of_item)


def store_of(log: Log, rewards: Float64Array, validation: float = 0.25) -> EpisodeStore:
    """The log as a store; the last users are held out for validation, one more for the test."""
    users = len(log.items) // LENGTH
    split = np.where(np.arange(users) < users * (1 - validation), 0, 1)
    split[-1] = 2
    return written(log, rewards, np.arange(users), split)


def written(
    log: Log,
    rewards: Float64Array,
    users: IntArray,
    split: IntArray,
    more: dict[str, IntArray] | None = None,
    **changes: Any,
) -> EpisodeStore:
    columns, lengths = {"item": log.items, "reward": rewards}, np.full(len(users), LENGTH)
    columns |= more or {}
    states = replace(item_states(len(users)), **changes)
    return EpisodeStore.from_arrays(columns, lengths, {"user": users, "split": split}, states)


def item_states(users: int) -> ItemStates:
    """Items of one tag each, with random embeddings; users without features."""
    tags = torch.from_numpy(np.arange(ITEMS)[:, None] % TAGS)
    embeddings = torch.from_numpy(np.random.default_rng(5).normal(size=(ITEMS, DIM))).float()
    return ItemStates(embeddings, torch.zeros(users, 0), 0.0, 1.0, tags=tags)


def clicks(log: Log, seed: int = 0) -> Float64Array:
    chosen = np.random.default_rng(seed).random(len(log.items)) < sigmoid(log.predictor)
    return chosen.astype(np.float64)


def views(store: EpisodeStore) -> tuple[EpisodeStore, EpisodeStore]:
    return store.split("train"), store.split("validation")


def fit(folder: Path, planted: Log, rewards: Float64Array) -> tuple[ItemRewardModel, Any]:
    return fit_item_reward_model(*views(store_of(planted, rewards)), folder, seed=0)


def test_planted_item_effects_are_recovered_and_calibrated(tmp_path: Path) -> None:
    planted = log(0, users=400)
    model, report = fit(tmp_path, planted, clicks(planted))
    assert np.corrcoef(model.item.numpy(), planted.of_item)[0, 1] > 0.95
    slope = np.polyfit(planted.of_item, model.item.numpy(), 1)[0]
    assert 0.8 < slope < 1.2
    assert {"item", "user"} <= report.kept.keys()
    assert report.loss < report.item_loss + 1e-9 < report.base_loss
    rows = RewardRows.of(store_of(planted, clicks(planted)).split("validation"), 10, 10**6, 0)
    predicted = model.expect(score_rows(model, rows)).double().numpy()
    assert calibration_error(predicted, rows.rewards.double().numpy()) < 0.05


def test_items_are_described_by_what_users_differ_in(tmp_path: Path) -> None:
    rng, users = np.random.default_rng(0), 300
    embeddings = np.random.default_rng(5).normal(size=(ITEMS, 16))
    embeddings[:, 0] = np.arange(ITEMS) % 2 * 2 - 1
    taste, items = rng.choice([-1.5, 1.5], users), rng.integers(ITEMS, size=(users, 2 * LENGTH))
    liked = rng.random(items.shape) < sigmoid(taste[:, None] * embeddings[items, 0])
    columns = {"item": items.ravel(), "reward": liked.ravel().astype(np.float64)}
    columns["timestamp"] = np.arange(items.size)
    store = EpisodeStore.from_arrays(
        columns,
        np.full(2 * users, LENGTH),
        {"user": np.repeat(np.arange(users), 2), "split": np.tile([0, 1], users)},
        replace(item_states(users), embeddings=torch.from_numpy(embeddings).float()),
    )
    model, report = fit_item_reward_model(*views(store), tmp_path / "first", seed=0)
    assert "interest" in report.kept
    weights = model.interests.weights[1:].abs()
    assert weights[0] > 3 * weights[1:].max()
    rates = model.interests.rates(model.interests.sums[:-1])[:, 1]
    assert np.corrcoef(rates, taste)[0, 1] > 0.8


def test_boredom_and_state_are_learned(tmp_path: Path) -> None:
    planted = log(1, boredom=3.0, users=300)
    model, report = fit(tmp_path, planted, clicks(planted))
    assert "exposure" in report.kept
    assert model.exposure[1, 0] < -1
    assert model.exposure[1, 1:].abs().max() < 0.5
    assert report.loss < report.item_loss


@pytest.mark.parametrize("by_tags", [True, False])
def test_effects_of_lists_are_learned_where_there_are_lists(tmp_path: Path, by_tags: bool) -> None:
    """Lists of five: later places are worth less, and items like those above them."""
    planted, places = log(2, users=400), {"place": np.tile(np.arange(5), 400 * LENGTH // 5)}
    tags, odds = (planted.items % TAGS).reshape(-1, 5), planted.predictor.reshape(-1, 5)
    above = np.tril(tags[:, :, None] == tags[:, None], -1).sum(2)
    odds -= 0.4 * np.arange(5) + 0.8 * above
    changes: dict[str, Any] = {} if by_tags else {"tags": torch.zeros(ITEMS, 0, dtype=torch.int64)}
    changes["embeddings"] = torch.eye(TAGS)[torch.arange(ITEMS) % TAGS]
    users, split = np.arange(400), (np.arange(400) >= 300).astype(np.int64)
    store = written(planted, clicks(planted), users, split, places, **changes)
    model, report = fit_item_reward_model(*views(store), tmp_path / "lists", seed=0)
    assert {"position", "above"} <= report.kept.keys()
    effects = torch.cat([model.above, model.position[:4]])
    np.testing.assert_allclose(effects.numpy(), [-0.8, -0.4, -0.8, -1.2, -1.6], atol=0.25)
    rows = RewardRows.of(store.split("validation"), LAGS, 10**6, 0)
    # Scores of all items, by which rules decide, are those of the top.
    top, given = rows.above[:, 0] < 0, (rows.states, rows.history, rows.users)
    every = model.scores(*given).gather(1, rows.items.unsqueeze(1))[:, 0]
    apart = score_rows(model, rows) - every
    torch.testing.assert_close(apart[top], torch.zeros(int(top.sum())), atol=1e-4, rtol=0)
    assert float(apart[~top].mean()) < -0.5
    # One row a decision: nothing is tried.
    store = written(planted, clicks(planted), users, split, **changes)
    model, report = fit_item_reward_model(*views(store), tmp_path / "items", seed=0)
    assert not {"position", "above"} & {effect.effect for effect in report.effects}


@pytest.mark.parametrize("known", [True, False])
def test_item_effects_are_adjusted_for_who_saw_them(known: bool, tmp_path: Path) -> None:
    """All items are alike, but users who click more see the second half of the catalogue more.
    Held-out sessions are later ones of the same users, or of users who were never seen."""
    rng = np.random.default_rng(3)
    sessions = np.arange(400)
    users = sessions // 2 if known else sessions
    eager = (rng.random(400) < 0.5)[users]
    half = rng.random((400, LENGTH)) < np.where(eager, 0.8, 0.2)[:, None]
    items = rng.integers(ITEMS // 2, size=half.shape) + half * (ITEMS // 2)
    predictor = np.where(eager, 1.0, -1.0)[:, None].repeat(LENGTH, 1)
    confounded = Log(items.ravel(), users, predictor.ravel(), np.zeros(ITEMS))
    rewards = clicks(confounded)
    split = sessions % 2 if known else (sessions >= 300).astype(np.int64)
    store = written(confounded, rewards, users, split)
    model, _ = fit_item_reward_model(*views(store), tmp_path, seed=0)
    shown = np.bincount(confounded.items, minlength=ITEMS)
    rates = np.bincount(confounded.items, rewards, minlength=ITEMS) / shown
    crude = np.log(rates / (1 - rates))

    def gap(of_items: Float64Array) -> float:
        return float(of_items[ITEMS // 2 :].mean() - of_items[: ITEMS // 2].mean())

    assert gap(crude) > 0.9
    assert abs(gap(model.item.numpy().astype(np.float64))) < 0.3 * gap(crude)


def test_for_new_users_the_session_tells_what_effects_of_users_tell(tmp_path: Path) -> None:
    planted, split = log(3, taste=4.0, users=300), (np.arange(300) >= 200).astype(np.int64)
    embeddings = torch.eye(TAGS)[torch.arange(ITEMS) % TAGS]
    store = written(planted, clicks(planted), np.arange(300), split, embeddings=embeddings)
    model, report = fit_item_reward_model(*views(store), tmp_path / "a", seed=0)
    assert report.new_users
    assert {"affinity", "tastes"} <= report.kept.keys()
    assert not model.user.any()
    assert not model.affinity.any()
    assert model.reach == MEMORY
    rows = RewardRows.of(store.split("validation"), model.reach, 10**6, 0)
    slope, intercept = calibrate(model, store.split("validation"), 10**6, 0)
    assert 0.85 < slope < 1.15
    assert abs(intercept) < 0.3
    # After ten steps, the session shows what its user likes, which the log never says.
    late = (torch.arange(len(rows)) % LENGTH >= 10).numpy()
    true = planted.predictor[split[planted.users] == 1][late]
    scores, alone = model.score(rows.states, rows.history, None, rows.items), copy.deepcopy(model)
    alone.tastes.weigh(torch.zeros(()))
    without = alone.score(rows.states, rows.history, None, rows.items)[late].numpy()
    gain = np.corrcoef(scores[late].numpy(), true) - np.corrcoef(without, true)
    assert gain[0, 1] > 0.1
    assert torch.equal(scores, model.score(rows.states, rows.history, rows.users, rows.items))
    again = refit_item_reward_model(tmp_path / "a", store.split("train"), tmp_path / "b", seed=0)
    for name, value in model.state_dict().items():
        assert torch.allclose(value, again.state_dict()[name], atol=0.05), name


def test_a_search_begins_and_ends_near_an_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted, few, counting = log(0, users=200), log(0, users=100), Mock(wraps=fit_effects)
    monkeypatch.setattr("ucfrec.user_model.reward_effects.fit_effects", counting)
    store, half = store_of(planted, clicks(planted, 1)), store_of(few, clicks(few))
    old = fit_item_reward_model(*views(half), tmp_path / "old", seed=0)[1]
    counting.reset_mock()
    cold = fit_item_reward_model(*views(store), tmp_path / "cold", seed=0)[1]
    fits = counting.call_count
    warm = fit_item_reward_model(*views(store), tmp_path / "warm", 0, first=tmp_path / "old")[1]
    assert counting.call_count - fits < 0.8 * fits
    assert warm.loss < 1.01 * cold.loss
    assert {"item", "user"} <= old.kept.keys() & warm.kept.keys()
    none = fit_item_reward_model(*views(store), tmp_path / "none", 0, first=tmp_path / "nowhere")[1]
    assert none == cold


def test_rewards_of_many_values_are_fitted_in_their_units(tmp_path: Path) -> None:
    planted = log(4, users=300)
    noise = np.random.default_rng(0).normal(0, 1, len(planted.items))
    rewards = 50 + 7 * (planted.predictor + noise)
    store = store_of(planted, rewards)
    model, _ = fit_item_reward_model(*views(store), tmp_path, seed=0)
    assert not model.binary
    rows = RewardRows.of(store.split("validation"), LAGS, 10**6, 0)
    scores = model.score(rows.states, rows.history, rows.users, rows.items)
    errors = (model.expect(scores) - rows.rewards).numpy()
    assert 1 - errors.var() / rows.rewards.numpy().var() > 0.25
    slope = np.polyfit(planted.of_item, model.item.numpy() * float(model.reward_std), 1)[0]
    assert slope == pytest.approx(7, rel=0.15)


def test_what_does_not_predict_is_left_out(tmp_path: Path) -> None:
    planted = log(5)
    model, report = fit(tmp_path, planted, 1.0 * (np.random.default_rng(1).random(3000) < 0.3))
    assert len(report.kept) <= 2
    assert report.loss > report.base_loss - 0.01
    for tried in report.effects:
        assert tried.kept == (tried.gain > tried.gain_error)
        if not tried.kept and tried.effect in ("user", "affinity", "state", "interaction"):
            assert not model.get_buffer(tried.effect).any()


def test_scores_do_not_depend_on_the_step_or_on_later_ones(tmp_path: Path) -> None:
    planted = log(6, boredom=1.0)
    rewards = clicks(planted)
    model, _ = fit(tmp_path, planted, rewards)
    later, scores = np.arange(len(planted.items)) % LENGTH >= 7, []
    changed = planted._replace(items=np.where(later, (planted.items + 11) % ITEMS, planted.items))
    for given, paid in ((planted, rewards), (changed, np.where(later, 1 - rewards, rewards))):
        rows = RewardRows.at(store_of(given, paid), np.arange(USERS), np.full(USERS, 7), LAGS)
        scores.append(model.scores(rows.states, rows.history, rows.users))
    assert torch.equal(scores[0], scores[1])


def test_test_rows_have_no_effect_and_statistics_come_from_training_rows(tmp_path: Path) -> None:
    planted = log(7)
    rewards = clicks(planted)
    first, row = fit(tmp_path / "a", planted, rewards)[0], np.arange(len(rewards))
    test, held_out = row >= (USERS - 1) * LENGTH, row >= (int(USERS * 0.75) + 1) * LENGTH
    changed = planted._replace(items=np.where(test, 0, planted.items))
    same, _ = fit(tmp_path / "b", changed, np.where(test, 1 - rewards, rewards))
    for name, value in first.state_dict().items():
        assert torch.equal(value, same.state_dict()[name]), name
    chosen, _ = fit(tmp_path / "c", planted, np.where(held_out, 1 - rewards, rewards))
    for name in ("state_mean", "state_std", "reward_mean", "reward_std", "vectors"):
        assert torch.equal(first.get_buffer(name), chosen.get_buffer(name)), name


def test_a_fit_repeats_and_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ucfrec.user_model.reward_fit._MAX_ROWS", 600)
    planted = log(8, users=60)
    store = store_of(planted, clicks(planted))
    first, report = fit_item_reward_model(*views(store), tmp_path / "a", seed=0)
    again, _ = fit_item_reward_model(*views(store), tmp_path / "b", seed=0)
    kept, kept_report = fit_item_reward_model(*views(store), tmp_path / "a", seed=0)
    assert kept_report == report
    for name, value in first.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
        assert torch.equal(value, kept.state_dict()[name]), name


def test_what_cannot_be_fitted_is_an_input_error(tmp_path: Path) -> None:
    planted = log(9, users=60)
    equal = store_of(planted, np.full(len(planted.items), 2.0))
    cases = {
        "all 900 training rewards equal 2": equal,
        "no held-out steps": store_of(planted, clicks(planted), 0.0),
    }
    for message, store in cases.items():
        with pytest.raises(InputError, match=message):
            fit_item_reward_model(*views(store), tmp_path / "run", seed=0)
    assert not (tmp_path / "run").exists()
