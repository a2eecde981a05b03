"""One rule decides alike wherever it acts: played, scored, ranked and recommended."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.support.replay import replayed
from tests.support.served import learn_tastes
from tests.support.tagged import ITEMS, tagged_log, tagged_store
from ucfrec import EpisodeStore, Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.logged_decisions import LoggedDecisions, seen_before, session_scores
from ucfrec.evaluation.ranking import Steps
from ucfrec.evaluation.ranking_baselines import PolicyRanker
from ucfrec.logs import LogMapping
from ucfrec.off_policy.score import logged_sessions, scored_steps
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.recommending.recommend import recommend
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.posterior import MEMORY
from ucfrec.user_model.reward_fit import fit_item_reward_model

SETTINGS = {
    "train.steps": 30, "train.learning_rate": 3e-3, "policy.dim": 16, "policy.context": 6,
    "policy.exposure": True, "policy.exposure_window": 4, "policy.advantage_weights": True,
    "policy.max_return": True, "augment.copies": 0, "rule.choose": False,
}  # fmt: skip
RULES = {
    "target": DecisionRule(3.0, temperature=1.0),
    "floor": DecisionRule(1.0, floor=0.5, temperature=0.7),
    "best": DecisionRule(3.0),
    "learned": DecisionRule(None, temperature=1.0),
    "filters": DecisionRule(3.0, temperature=2.0, top_k=9, exclude_seen=True, tag_window=2),
    "run": DecisionRule(3.0, temperature=1.0, tag_run=2),
    "far": DecisionRule(3.0, temperature=1.0, tag_window=8),  # further than the policy sees
    "weighted": DecisionRule(
        3.0, temperature=1.0, reward_weight=1.0
    ),  # by tastes learned in the session
}
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
    assert term is not None
    for parameter in term.parameters():
        parameter.data += 0.05 * (parameter.data + 1e-9).sign()
    views = training_views(EpisodeStore.open(folder / "store"))
    model, _ = fit_item_reward_model(*views, folder / "rewards", seed=0)
    trained = replace(trained, reward_model=model)
    learn_tastes(trained)
    return trained


def last_sessions(log: pd.DataFrame) -> Iterator[tuple[Any, list[int], list[float]]]:
    """Users with the items and rewards of their last sessions, which are long enough to matter."""
    for user, rows in log.sort_values("timestamp").groupby("user_id"):
        pauses = rows.timestamp.diff() > 120 * 60_000
        latest = rows[pauses.cumsum() == pauses.sum()]
        if len(latest) > 3:
            yield user, latest.item_id.tolist(), latest.reward.tolist()


def test_logged_sessions_are_read_as_far_back_as_a_rule_looks(
    folder: Path, trained: TrainedPolicy
) -> None:
    for rule in (DecisionRule(3.0, tag_run=10), DecisionRule(3.0, tag_window=10)):
        decider = replace(trained, reward_model=None).decider(rule)
        assert decider.policy.config.context < 10
        logged = EpisodeStore.open(folder / "store")
        known = LoggedDecisions.at(decider, logged, np.array([0]), logged.lengths[:1] - 1)
        assert known.shown.items.shape == (1, 10)
        far = LoggedDecisions.at(
            trained.decider(rule), logged, np.array([0]), logged.lengths[:1] - 1
        )
        assert far.shown.items.shape == (1, MEMORY)


@pytest.mark.parametrize("rule", RULES)
def test_played_scored_ranked_and_recommended_alike(
    folder: Path, trained: TrainedPolicy, rule: str, tmp_path: Path
) -> None:
    log, given = tagged_log(), RULES[rule]
    sessions = list(last_sessions(log))[:6]
    log = log[log.user_id.isin([user for user, *_ in sessions])]
    assert trained.item_ids is not None
    numbers = {item: number for number, item in enumerate(trained.item_ids.tolist())}
    expected = {}
    for user, items, rewards in sessions:
        known = [numbers[item] for item in items]
        expected[user] = replayed(trained, given, known, rewards, user).numpy()
    assert max(len(found) for found in expected.values()) > trained.policy.config.context + 1

    # One more row for each user: the step to decide, with an arbitrary item and reward.
    latest = log.sort_values("timestamp").groupby("user_id").tail(1)
    more = latest.assign(timestamp=latest.timestamp + 1000, item_id=5, reward=1.0)
    pd.concat([log, more]).to_parquet(tmp_path / "log.parquet")
    with logged_sessions(
        trained.folder, trained, [tmp_path / "log.parquet"], LogMapping()
    ) as logged:
        store, ranker = logged.store, PolicyRanker(trained, given, "ucf")
        batches = list(scored_steps(trained, store, given))
        (batch,) = batches
        ends = np.flatnonzero(np.append(np.diff(batch.episodes) > 0, True))
        for user, found in expected.items():
            last = max(end for end in ends if logged.users[batch.episodes[end]] == user)
            rows = np.arange(last - len(found) + 1, last + 1)
            scored = batch.log_probabilities[rows].exp().numpy()
            np.testing.assert_allclose(scored, found, rtol=1e-3, atol=1e-6)
            steps = (batch.episodes[rows], batch.steps[rows])
            ranked = ranker.scores(Steps(store, *steps, np.full(len(rows), -1)))
            again = given.log_probabilities(ranked).exp().numpy()
            np.testing.assert_allclose(again, found, rtol=1e-3, atol=1e-6)

    histories = histories_of_frame(trained, log, LogMapping())
    (frame,) = recommend(trained, histories, ITEMS, rule=given, filter_seen=False)
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


def test_rewards_of_the_session_lower_the_target_of_recommendations(trained: TrainedPolicy) -> None:
    """A session that has earned r with target T is recommended as one that has not, with T − r."""
    log = tagged_log()
    user, items, _ = max(last_sessions(log), key=lambda session: len(session[1]))
    window = trained.policy.config.context
    assert len(items) > window + trained.returns.horizon
    rows = log[log.user_id == user].tail(len(items))

    def scores(rewards: float, target: float) -> pd.Series:
        # Rewards change the state too, so only one before the policy's memory is changed.
        first = np.arange(len(rows)) == 0
        given = rows.assign(reward=np.where(first, rewards, 0.0))
        histories = histories_of_frame(trained, given, LogMapping())
        rule = DecisionRule(target)
        (frame,) = recommend(trained, histories, ITEMS, rule=rule, filter_seen=False)
        return frame.sort_values("item_id").score.reset_index(drop=True)

    # Liking is clipped: any reward of 1 or more makes the same states.
    low, high, same = scores(1.0, 4.0), scores(3.0, 4.0), scores(3.0, 6.0)
    if trained.returns.per_session:
        np.testing.assert_allclose(low, same, atol=1e-5)
        assert not np.allclose(low, high, atol=1e-6)
    else:
        np.testing.assert_allclose(low, high, atol=1e-5)


def test_items_of_a_session_count_as_seen_from_the_next_step(folder: Path) -> None:
    store = EpisodeStore.open(folder / "store")
    trained = TrainedPolicy.load(folder / "session")
    episodes, steps = (each[:200] for each in store.all_steps())
    seen = seen_before(store, episodes, steps)
    items = store.step_values("item", episodes, steps)
    starts = np.maximum.accumulate(np.where(steps == 0, np.arange(200), 0))
    for row in range(200):
        assert set(seen[row].nonzero()[:, 0].tolist()) == set(items[starts[row] : row].tolist())
    decider = trained.decider(replace(trained.rule, exclude_seen=True))
    left_out = np.isneginf(session_scores(decider, store, episodes, steps).numpy())
    np.testing.assert_array_equal(left_out, seen.numpy())


def test_a_user_who_has_seen_all_candidates_gets_no_row(folder: Path) -> None:
    trained, log = TrainedPolicy.load(folder / "session"), tagged_log()
    (user, items, _), (other, *_) = list(last_sessions(log))[:2]
    log = log[log.user_id.isin([user, other])]
    rule = replace(trained.rule, exclude_seen=True)
    (frame,) = recommend(
        trained,
        histories_of_frame(trained, log, LogMapping()),
        3,
        rule=rule,
        filter_seen=False,
        candidates=items[:1],
    )
    assert user not in set(frame.user_id)
