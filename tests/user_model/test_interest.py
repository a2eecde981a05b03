"""Interests are what users were shown until the decision, in training as in serving."""

from pathlib import Path

import numpy as np
import pytest
import torch

import ucfrec.user_model.interest as module
from ucfrec import EpisodeStore
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer, sessions_before
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.user_model.interest import find_user_rows
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import fit_item_reward_model, refit_item_reward_model
from ucfrec.user_model.reward_report import RewardRows, score_rows

USERS, SESSIONS, STEPS, ITEMS, SIZE = 150, 4, 6, 20, 3


def log_of(binary: bool) -> EpisodeStore:
    """Users like items in a direction of their own; their last session is held out."""
    rng = np.random.default_rng(3)
    embeddings = rng.normal(size=(ITEMS, SIZE)) * [2.0, 1.0, 0.3]
    shape = USERS, SESSIONS, STEPS
    items = rng.integers(ITEMS, size=shape)
    tastes = rng.normal(size=(USERS, SIZE)) * [1.2, 0.0, 0.0]
    odds = np.einsum("usni,ui->usn", embeddings[items], tastes) + rng.normal(size=ITEMS)[items]
    rewards = odds + rng.normal(size=shape)
    if binary:
        rewards = 1.0 * (rng.random(shape) < 1 / (1 + np.exp(-odds)))
    hours = rng.random((USERS, 1, 1)) + 30 * np.arange(SESSIONS)[:, None] + 0.1 * np.arange(STEPS)
    columns = {"item": items.ravel(), "reward": rewards.ravel()}
    columns["timestamp"] = (3_600_000 * hours).astype(np.int64).ravel()
    episodes = {"split": np.tile(np.repeat([0, 1], [SESSIONS - 1, 1]), USERS)}
    episodes["user"] = np.repeat(np.arange(USERS), SESSIONS)
    vectors = torch.from_numpy(embeddings).float()
    states = ItemStates(vectors, torch.zeros(USERS, 0), float(rewards.min()), float(rewards.max()))
    return EpisodeStore.from_arrays(columns, np.full(USERS * SESSIONS, STEPS), episodes, states)


def fitted(binary: bool, folder: Path) -> tuple[ItemRewardModel, EpisodeStore]:
    store = log_of(binary)
    train, validation = store.split("train"), store.split("validation")
    model, report = fit_item_reward_model(train, validation, folder, 0)
    assert "interest" in report.kept
    assert report.loss < report.item_loss - 0.02
    return model, validation


@pytest.mark.parametrize("at_once", [7, 2**17])
@pytest.mark.parametrize("binary", [True, False])
def test_sums_are_those_of_a_users_earlier_rows(
    binary: bool, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_AT_ONCE", at_once)
    view = log_of(binary).select(np.arange(40))
    model = ItemRewardModel({"state": 2, "action": SIZE, "items": ITEMS, "users": USERS})
    for name in ("vectors", "interests.usual"):
        model.get_buffer(name).uniform_(0.1, 0.9)
    model.binary.fill_(binary)
    users = torch.tensor([0, 3, 9, -1, 140, 5])
    assert find_user_rows(view) is not None
    names = "item", "reward", "timestamp"
    items, rewards, times = (torch.from_numpy(view.column(name)) for name in names)
    of_row = torch.arange(40 * STEPS) // (SESSIONS * STEPS)
    moments = times[[0, 40, 3, 9, 50, -1]] + 1
    found = module.sum_before(view, users, moments, lambda rewards: rewards, model.sum_rows)
    for user, moment, sums in zip(users, moments, found, strict=True):
        some = (of_row == user) & (times < moment)
        usual = model.interests.usual[items[some].long()]
        unusual = (rewards[some] - usual).unsqueeze(1)
        variance = usual * (1 - usual) if binary else torch.ones_like(usual)
        expected = [unusual.sum(0), (unusual * model.vectors[items[some].long()]).sum(0)]
        torch.testing.assert_close(sums, torch.cat([*expected, variance.sum().view(1)]).float())
    assert not found[3].any()
    assert not found[4].any()


@pytest.mark.parametrize("binary", [True, False])
def test_what_is_fitted_is_what_is_served(binary: bool, tmp_path: Path) -> None:
    model, validation = fitted(binary, tmp_path)
    rows = RewardRows.of(validation, model.reach, 10**6, 0)
    followed = score_rows(model, rows)
    read = fit_item_reward_model(validation, validation, tmp_path, 0)[0]
    assert read.user_rows is None
    torch.testing.assert_close(score_rows(read, rows), followed, atol=2e-5, rtol=1e-4)
    every = read.scores(rows.states, rows.history, rows.users)
    of_rows = every.gather(1, rows.items.unsqueeze(1)).squeeze(1)
    torch.testing.assert_close(of_rows, followed, atol=2e-5, rtol=1e-4)


def test_rows_of_training_count_once_where_sessions_go_on(tmp_path: Path) -> None:
    model, validation = fitted(True, tmp_path)
    columns = {name: validation.whole.column(name) for name in ("item", "reward", "timestamp")}
    users, steps = np.arange(USERS), np.arange(USERS) % (SESSIONS * STEPS)
    episodes, states = {"split": 0 * users, "user": users}, validation.item_states
    lengths = np.full(USERS, SESSIONS * STEPS)
    store = EpisodeStore.from_arrays(columns, lengths, episodes, states)
    sizes = {"state": store.state_size, "action": SIZE, "items": ITEMS, "users": USERS}
    policy = DTPolicy(DTConfig(context=5, dim=8), sizes)
    policy.head.start_from(states.embeddings, torch.ones(ITEMS))
    rule = DecisionRule(0.0, reward_weight=1.0, policy_weight=0.0)
    scorer = Scorer(policy.eval(), rule, states, ReturnToGo(), model)
    later = steps >= (SESSIONS - 1) * STEPS
    sessions = sessions_before(scorer, store, users[later], steps[later])
    assert (sessions.trained_steps == (SESSIONS - 1) * STEPS).all()
    found = scorer.scores(sessions)
    times = torch.from_numpy(store.step_values("timestamp", users[later], steps[later]))
    sums = model.sums_before(sessions.users, times)
    before, shown = sessions.states[:, -1], sessions.shown
    for item in range(ITEMS):
        every = torch.full(times.shape, item)
        score = model.score(before, shown, sessions.users, every, sums=sums)
        found[:, item] -= score
    torch.testing.assert_close(found, found[:, :1].expand_as(found), atol=1e-4, rtol=0)


def test_a_click_raises_items_like_it_at_once(tmp_path: Path) -> None:
    model, validation = fitted(True, tmp_path)
    model.user_rows = None
    for name in ("state", "interaction", "exposure"):
        model.get_buffer(name).zero_()
    rows = RewardRows.of(validation, model.reach, 10**6, 0)
    unknown = torch.full_like(rows.users, -1)
    before, after = (model.scores(rows.states, rows.history.latest(n), unknown) for n in (0, STEPS))
    assert torch.equal(before, before[:1].expand_as(before))
    liked = (rows.history.rewards[:, :STEPS] * 2 - 1) * (rows.history.items[:, :STEPS] >= 0)
    first = validation.item_states.embeddings[:, 0]
    seen = (liked * first[rows.history.items[:, :STEPS].clamp(min=0)]).sum(1)
    slopes = torch.linalg.lstsq(torch.stack([first, torch.ones(ITEMS)], 1), (after - before).T)
    assert float(torch.corrcoef(torch.stack([slopes.solution[0], seen]))[0, 1]) > 0.8


def test_a_refit_follows_users_too(tmp_path: Path) -> None:
    model, _ = fitted(True, tmp_path / "first")
    store = log_of(True)
    again = refit_item_reward_model(tmp_path / "first", store.whole, tmp_path / "second", 0)
    # Held-out rows count, too.
    ratio = again.interests.sums[:-1, -1].sum() / model.interests.sums[:-1, -1].sum()
    assert float(ratio) == pytest.approx(SESSIONS / (SESSIONS - 1), rel=0.02)
