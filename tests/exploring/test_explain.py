"""The parts of a score add up to what recommends, and what filters exclude is named."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.recommending.test_recommend import random_log
from ucfrec import DecisionRule, FeatureTable, LogMapping, Recommender
from ucfrec.errors import InputError
from ucfrec.exploring.explain import PARTS, Explained, explain, read_pasted
from ucfrec.python_api.given_data import read_histories


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Recommender:
    folder = tmp_path_factory.mktemp("explain")
    tags = pd.DataFrame({"item_id": range(30), "tags": [[f"t{n % 5}"] for n in range(30)]})
    tags.to_parquet(folder / "tags.parquet")
    mapping = LogMapping(item_features=(FeatureTable((folder / "tags.parquet",), "item_id"),))
    settings = {
        **{"train.steps": 30, "policy.dim": 16, "policy.context": 4, "policy.exposure": True},
        **{"rule.sessions": 3, "rule.quantiles": [1.0]},
    }
    given: dict[str, Any] = {"mapping": mapping, "session_by": "gap", "gap_minutes": 20}
    return Recommender("dt", settings=settings).fit(random_log(), folder / "run", **given)


def explained(
    policy: Recommender, rule: DecisionRule, seen: bool = False, **more: Any
) -> Explained:
    (user,) = read_histories(policy.trained, None, None, [7])
    return explain(policy.trained, rule, user, 5, seen, **more)


RULES = [DecisionRule(2.0, reward_weight=2.0), DecisionRule(2.0, policy_weight=0.5)]


@pytest.mark.parametrize(
    "rule", [DecisionRule(2.0), *RULES, DecisionRule(2.0, reward_weight=8.0, lookahead=3.0)]
)
def test_the_parts_order_items_as_recommend_does(policy: Recommender, rule: DecisionRule) -> None:
    found = explained(policy, rule)
    frame = policy.recommend(k=5, rule=rule, users=[7], filter_seen=False)
    assert [card.item_id for card in found.cards] == frame.item_id.tolist()
    scores = np.array([sum(card.parts.values()) for card in found.cards])
    np.testing.assert_allclose(np.diff(scores), np.diff(frame.score), atol=1e-4)
    assert all(card.parts.keys() == set(PARTS) for card in found.cards)
    moved = {name: any(abs(card.parts[name]) > 1e-6 for card in found.cards) for name in PARTS}
    assert moved["reward weight"] == bool(rule.reward_weight)
    assert bool(rule.lookahead) >= moved["lookahead"]  # this log shows no end of sessions
    assert moved["policy"]


def test_excluded_items_have_their_reason(policy: Recommender) -> None:
    by_seen = explained(policy, DecisionRule(2.0), seen=True).excluded
    assert {reason for *_, reason in by_seen} == {"the user has seen it"}
    ranks = [rank for _, rank, _ in by_seen]
    assert ranks == sorted(ranks)
    tagged = explained(policy, DecisionRule(2.0, tag_window=2))
    last = [item for item, *_ in tagged.rows[:2]]
    assert tagged.excluded
    for item_id, _, reason in tagged.excluded:
        assert reason == "it shares a tag with one of the last 2 items"
        assert item_id % 5 in {item % 5 for item in last}
    left_out = {item_id for item_id, *_ in tagged.excluded}
    assert not {card.item_id for card in tagged.cards} & left_out
    assert not explained(policy, DecisionRule(2.0)).excluded
    some = explained(policy, DecisionRule(2.0, tag_window=2), candidates=["1", "6", "7"])
    assert {card.item_id for card in some.cards} | {item for item, *_ in some.excluded} == {1, 6, 7}
    assert all(rank <= 3 for _, rank, _ in some.excluded)


def test_a_moment_hides_what_was_shown_later(policy: Recommender) -> None:
    now = explained(policy, DecisionRule(2.0), seen=True)
    _, _, time = now.rows[0]
    moment = round(1000 * time.timestamp())
    earlier = explained(policy, DecisionRule(2.0), seen=True, time_ms=moment)
    assert earlier.rows == [row for row in now.rows if row[2] < time]
    # Only what was shown by then is excluded as seen.
    assert {item for item, *_ in earlier.excluded} <= {item for item, *_ in earlier.rows}
    # As with a log that ends there.
    log = random_log()
    log = log[(log.user_id == 7) & (log.timestamp < moment)]
    frame = policy.recommend(log, k=5, rule=DecisionRule(2.0))
    assert [card.item_id for card in earlier.cards] == frame.item_id.tolist()
    assert not earlier.new_session
    much_later = explained(policy, DecisionRule(2.0), time_ms=moment + 10**9)
    assert (much_later.new_session, much_later.rows) == (True, now.rows)


def test_items_that_won_by_chance_are_marked(policy: Recommender) -> None:
    drawn = explained(policy, DecisionRule(2.0, temperature=50.0), seed=3)
    again = explained(policy, DecisionRule(2.0, temperature=50.0), seed=4)
    assert [card.item_id for card in drawn.cards] != [card.item_id for card in again.cards]
    scores = [sum(card.parts.values()) for card in drawn.cards]
    marks = [score < max(scores[place:]) for place, score in enumerate(scores)]
    assert [card.by_chance for card in drawn.cards] == marks
    assert any(marks)
    assert not any(card.by_chance for card in explained(policy, DecisionRule(2.0)).cards)


def test_a_read_pasted_is_recommended_for(policy: Recommender) -> None:
    frame = read_pasted("3, 1\n\n5\n 7,0 ")
    assert frame.item_id.tolist() == ["3", "5", "7"]
    assert frame.reward.tolist() == [1, 0, 0]
    (user,) = read_histories(policy.trained, frame, None, None)
    found = explain(policy.trained, DecisionRule(2.0), user, 4, True)
    assert [str(item) for item, *_ in found.rows] == ["7", "5", "3"]
    assert len(found.cards) == 4
    for text, message in (
        ("3, 1\n5, x", "line 2 of the history is '5, x'; write item_id"),
        ("3, nan", "line 1"),
    ):
        with pytest.raises(InputError, match=message):
            read_pasted(text)
