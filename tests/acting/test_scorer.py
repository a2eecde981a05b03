"""Scores are those of a naive computation: simulated, scored, ranked and recommended."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from tests.policies.test_ucf import (
    CATALOG,
    ITEMS,
    VECTORS,
    B,
    K,
    build,
    random_windows,
    sessions_of,
)
from tests.support.replay import replayed
from tests.support.served import boredom, learn_interests, recommend
from tests.support.tagged import ITEMS as MANY
from tests.support.tagged import tagged_log, tagged_store
from ucfrec import EpisodeStore, Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer, logged_scores
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import UserRows
from ucfrec.episodes.windows import Windows, seen_before
from ucfrec.errors import InputError
from ucfrec.evaluation.ranking import Later
from ucfrec.evaluation.ranking_table import PolicyRanker
from ucfrec.logs.mapping import LogMapping
from ucfrec.off_policy.score import read_logged_sessions, score_steps
from ucfrec.policies.baselines import ItemKNNPolicy
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.reward import LAGS, ItemRewardModel
from ucfrec.user_model.reward_fit import fit_item_reward_model

SETTINGS = {
    "train.steps": 30, "train.learning_rate": 3e-3, "policy.dim": 16, "policy.context": 6,
    "policy.exposure": True, "policy.exposure_window": 4,
    "augment.copies": 0, "rule.choose": False,
}  # fmt: skip
RULES = {
    "target": DecisionRule(3.0, temperature=1.0),
    "minimum": DecisionRule(1.0, minimum_target=0.5, temperature=0.7),
    "best": DecisionRule(3.0),
    "filters": DecisionRule(3.0, temperature=2.0, top_k=9, exclude_seen=True, tag_window=2),
    "run": DecisionRule(3.0, temperature=1.0, tag_run=2),
    "far": DecisionRule(3.0, temperature=1.0, tag_window=8),  # further than the policy sees
    # By interests, also those shown in the session.
    "weighted": DecisionRule(3.0, temperature=1.0, reward_weight=1.0),
}
EXPOSURE = {"exposure": True, "exposure_window": 3}
TAGS = torch.tensor(
    [[0, -1], [0, 5], [1, -1], [1, -1], [2, -1], [2, 5], [3, -1], [3, -1], [4, 1], [4, -1], [4, 0]]
)
MORE = {"session": {}, "horizon": {"policy.return_to_go": "horizon", "policy.horizon": 2}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store, and a run on it for each definition of the return-to-go."""
    folder = tmp_path_factory.mktemp("decisions")
    store = tagged_store(folder)
    fit_item_reward_model(*training_views(store), folder / "rewards", seed=0)
    for name, more in MORE.items():
        Recommender("ucf", settings=SETTINGS | more).fit(store, folder / name)
    return folder


@pytest.fixture(params=MORE)
def trained(folder: Path, request: pytest.FixtureRequest) -> TrainedPolicy:
    trained = TrainedPolicy.load(folder / request.param)
    # After 30 updates the term is small: with larger weights, a wrong lag would show.
    term = trained.policy.head.exposure  # type: ignore[union-attr]
    for parameter in term.parameters():
        parameter.data += 0.05 * (parameter.data + 1e-9).sign()
    views = training_views(EpisodeStore.open(folder / "store"))
    model, _ = fit_item_reward_model(*views, folder / "rewards", seed=0)
    trained = replace(trained, reward_model=model)
    learn_interests(trained)
    return trained


# Against a naive computation, session by session and item by item.


def scorer_of(name: str, tagged: bool, rule: DecisionRule) -> Scorer:
    """A policy of random weights with a reward model of random effects."""
    torch.manual_seed(4)
    states = ItemStates(torch.randn(ITEMS, 4), torch.zeros(0, 0), 0.0, 1.0)
    states = replace(states, tags=TAGS) if tagged else states
    sizes = CATALOG | {"users": 3, "tags": 2 if tagged else 0}
    policy = build(name, sizes, **({} if name == "item-knn" else EXPOSURE))
    model = ItemRewardModel(sizes)
    for each in ("vectors", "item", "user", "affinity", "state", "interaction", "exposure"):
        model.get_buffer(each).normal_()
    model.likeness.start_from(states)
    model.interests.sums.uniform_()
    model.interests.weigh(torch.randn(5))
    model.binary.fill_(True)
    if isinstance(policy, ItemKNNPolicy):
        policy.cosines.uniform_(0.1, 1)
        policy.neighbors.random_(0, ITEMS)
    else:
        policy.head.start_from(states.embeddings, torch.rand(ITEMS))
        policy.head.exposure.start_from(states, torch.rand(50))  # type: ignore[union-attr]
        for parameter in policy.parameters():
            parameter.data += 0.1 * torch.randn_like(parameter)
    return Scorer(policy.eval(), rule, states, ReturnToGo(), model, boredom(model.likeness))


def naive_scores(scorer: Scorer, windows: Windows, excluded: Tensor) -> Tensor:
    """What `Scorer.scores` should be, without a product over all items."""
    rule, sessions = scorer.rule, sessions_of(windows)
    shown = sessions.shown
    targets = (rule.target - sessions.collected).clamp(min=rule.minimum_target)
    returns_to_go = ReturnToGo().before(targets, windows.rewards).masked_fill(~windows.mask, 0.0)
    with torch.no_grad():
        outputs = scorer.policy.act(replace(windows, returns_to_go=returns_to_go))
        scores = rule.policy_weight * outputs
        for item in range(ITEMS):
            every = torch.full((B,), item)
            score = scorer.reward_model.score(windows.states[:, -1], shown, sessions.users, every)
            if rule.lookahead:
                score = scorer.reward_model.expect(score)
                steps, recent = windows.timesteps[:, -1].numpy(), shown.latest(LAGS)
                given, chance = (recent, every), scorer.session_end.probabilities
                unpaid, paid = (chance(*given, np.full(B, paid), steps) for paid in (0.0, 1.0))
                end = torch.from_numpy(unpaid) * (1 - score) + torch.from_numpy(paid) * score
                score = (score + (1 - end) * rule.lookahead).float()
            scores[:, item] += rule.reward_weight * score
    scores = scores.masked_fill(excluded, -torch.inf)
    for row in range(B):
        items = [int(item) for item in shown.items[row] if item >= 0]
        recent = {int(tag) for item in items[: rule.tag_window] for tag in TAGS[item]} - {-1}
        main = [int(TAGS[item, 0]) for item in items[: rule.tag_run]]
        liked = shown.rewards[row, : rule.tag_run] >= 0.5
        tired = len(main) == rule.tag_run > 0 and len({*main}) == 1 and bool(liked.all())
        for without in (
            [bool(recent & {int(tag) for tag in tags}) for tags in TAGS],
            [tired and int(tags[0]) == main[0] for tags in TAGS],
        ):
            left = scores[row].masked_fill(torch.tensor(without), -torch.inf)
            scores[row] = left if (left > -torch.inf).any() else scores[row]
    return scores


PLAIN = DecisionRule(3.0, minimum_target=1.5)
NAIVE = {
    "plain": PLAIN,
    "rewards": replace(PLAIN, reward_weight=0.7, policy_weight=0.0),
    "ahead": replace(PLAIN, reward_weight=2.0, policy_weight=0.5, lookahead=3),
    "window": replace(PLAIN, reward_weight=0.7, tag_window=1),
    "filters": replace(PLAIN, tag_window=2, tag_run=1),
}


@pytest.mark.parametrize("rule", NAIVE)
@pytest.mark.parametrize("tagged", [True, False])
@pytest.mark.parametrize("name", ["ucf", "dt", "item-knn"])
def test_scores_are_those_of_a_naive_computation(name: str, tagged: bool, rule: str) -> None:
    if not tagged and (NAIVE[rule].tag_window or NAIVE[rule].tag_run):
        with pytest.raises(InputError, match="but the store has none"):
            scorer_of(name, tagged, NAIVE[rule])
        return
    scorer, windows = scorer_of(name, tagged, NAIVE[rule]), random_windows(CATALOG)
    # The first session was shown and liked one tag only, and may only be shown this one.
    excluded = torch.zeros(B, ITEMS, dtype=torch.bool)
    excluded[2, 3], excluded[0] = True, TAGS[:, 0] != TAGS[4, 0]
    windows = replace(windows, actions=windows.actions.clone(), rewards=windows.rewards.clone())
    windows.actions[0, -3:-1], windows.rewards[0, -3:-1] = 4, 1.0
    sessions = sessions_of(windows)
    before = {key: value.clone() for key, value in scorer.policy.state_dict().items()}
    found = scorer.scores(sessions, excluded=excluded)
    expected = naive_scores(scorer, windows, excluded)
    assert torch.equal(found.isneginf(), expected.isneginf())
    both = (each.log_softmax(-1) for each in (found, expected))
    torch.testing.assert_close(*both, rtol=1e-4, atol=1e-4)
    # One session alone, and some items alone, have the same scores.
    alone = scorer.scores(sessions.at(slice(1, 2)), excluded=excluded[1:2])
    torch.testing.assert_close(alone[0], found[1], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(dict(scorer.policy.state_dict()), before, rtol=0, atol=0)


def test_all_may_be_left_out_where_it_is_said_and_no_score_may_be_nan() -> None:
    scorer = scorer_of("dt", True, DecisionRule(3.0))
    sessions = sessions_of(random_windows(CATALOG))
    excluded = torch.zeros(B, ITEMS, dtype=torch.bool)
    excluded[1] = True
    with pytest.raises(InputError, match="in 1 of 3 decisions every item is excluded"):
        scorer.scores(sessions, excluded=excluded)
    assert scorer.scores(sessions, excluded=excluded, empty=True)[1].isneginf().all()
    excluded[1, 4] = False
    assert scorer.scores(sessions, excluded=excluded)[1].argmax() == 4
    scorer.policy.head.bias.data[0] = torch.nan  # type: ignore[union-attr,index]
    with pytest.raises(InputError, match="in 3 of 3 decisions scores are not numbers"):
        Scorer(scorer.policy, scorer.rule, scorer.states).scores(sessions)


def test_vectors_are_predicted_at_the_target() -> None:
    windows, policy = random_windows(VECTORS), build("dt", VECTORS)
    sessions = sessions_of(windows)
    found = Scorer(policy, DecisionRule(2.0)).act(sessions)
    targets = ReturnToGo().before(2.0 - sessions.collected, windows.rewards) * windows.mask
    with torch.no_grad():
        torch.testing.assert_close(found, policy.act(replace(windows, returns_to_go=targets)))


def test_a_rule_needs_what_it_uses() -> None:
    policy, states = build("dt", CATALOG), ItemStates(torch.eye(ITEMS), torch.zeros(0, 0), 0, 1)
    with pytest.raises(InputError, match="no reward model of items"):
        Scorer(policy, DecisionRule(1.0, reward_weight=0.5), states)
    for rule in (DecisionRule(1.0, tag_window=2), DecisionRule(1.0, tag_run=2)):
        with pytest.raises(InputError, match="the store has none"):
            Scorer(policy, rule, None)
    tagged = Scorer(policy, DecisionRule(1.0), replace(states, tags=TAGS))
    assert K < 10  # items further back than the policy sees are known from the session
    tagged.under(DecisionRule(1.0, tag_window=10))
    with pytest.raises(InputError, match="of a session 10 are known"):
        tagged.under(DecisionRule(1.0, tag_window=11))


# Wherever it acts.


def last_sessions(log: pd.DataFrame) -> Iterator[tuple[Any, list[int], list[float]]]:
    """Users with the items and rewards of their last sessions, which are long enough to matter."""
    for user, rows in log.sort_values("timestamp").groupby("user_id"):
        pauses = rows.timestamp.diff() > 120 * 60_000
        latest = rows[pauses.cumsum() == pauses.sum()]
        if len(latest) > 3:
            yield user, latest.item_id.tolist(), latest.reward.tolist()


ACTING = [("session", rule) for rule in RULES] + [("horizon", "minimum")]


@pytest.mark.parametrize(("trained", "rule"), ACTING, indirect=["trained"])
def test_played_scored_ranked_and_recommended_alike(
    trained: TrainedPolicy, rule: str, tmp_path: Path
) -> None:
    log, given = tagged_log(), RULES[rule]
    sessions = list(last_sessions(log))[:4]
    log = log[log.user_id.isin([user for user, *_ in sessions])]
    numbers = {item: number for number, item in enumerate(trained.item_ids.tolist())}
    expected = {
        user: replayed(trained, given, [numbers[item] for item in items], rewards, user).numpy()
        for user, items, rewards in sessions
    }
    assert max(len(found) for found in expected.values()) > trained.policy.config.context + 1
    # One more row for each user: the step to decide, with an arbitrary item and reward.
    latest = log.sort_values("timestamp").groupby("user_id").tail(1)
    more = latest.assign(timestamp=latest.timestamp + 1000, item_id=5, reward=1.0)
    pd.concat([log, more]).to_parquet(tmp_path / "log.parquet")
    with read_logged_sessions(trained, [tmp_path / "log.parquet"], LogMapping()) as logged:
        store, ranker = logged.store, PolicyRanker(trained, given)
        later = Later(store, UserRows.of(store, np.array(logged.users), None))
        (batch,) = score_steps(trained, store, later.rows, given)
        ends = np.flatnonzero(np.append(np.diff(batch.episodes) > 0, True))
        for user, found in expected.items():
            last = max(end for end in ends if logged.users[batch.episodes[end]] == user)
            rows = np.arange(last - len(found) + 1, last + 1)
            scored = batch.log_probabilities[rows].exp().numpy()
            np.testing.assert_allclose(scored, found, rtol=1e-3, atol=1e-6)
            ranked = ranker.scores(later.steps(rows, filter_seen=False))
            again = given.log_probabilities(ranked).exp().numpy()
            np.testing.assert_allclose(again, found, rtol=1e-3, atol=1e-6)
    histories = histories_of_frame(trained, log, LogMapping())
    (frame,) = recommend(trained, histories, MANY, rule=given, filter_seen=False)
    for user, found in expected.items():
        rows = frame[frame.user_id == user]
        listed = [numbers[item] for item in rows.item_id]
        chances = np.zeros(len(numbers))
        if given.temperature == 0:
            chances[listed[0]] = 1
        else:
            kept = np.sort(rows.score)[::-1][: given.top_k]
            left = rows.score.to_numpy() >= kept[-1]
            shares = np.exp(rows.score.to_numpy() / given.temperature) * left
            chances[listed] = shares / shares.sum()
        np.testing.assert_allclose(chances, found[-1], rtol=1e-3, atol=1e-6)


def test_items_of_a_session_count_as_seen_from_the_next_step(folder: Path) -> None:
    store = EpisodeStore.open(folder / "store")
    trained = TrainedPolicy.load(folder / "session")
    episodes, steps = (each[:200] for each in store.all_steps())
    seen = seen_before(store, episodes, steps)
    items = store.step_values("item", episodes, steps)
    starts = np.maximum.accumulate(np.where(steps == 0, np.arange(200), 0))
    for row in range(200):
        assert set(seen[row].nonzero()[:, 0].tolist()) == set(items[starts[row] : row].tolist())
    scorer = trained.scorer(replace(trained.rule, exclude_seen=True))
    left_out = np.isneginf(logged_scores(scorer, store, episodes, steps).numpy())
    np.testing.assert_array_equal(left_out, seen.numpy())
