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


def explained(policy: Recommender, rule: DecisionRule, seen: bool = False) -> Explained:
    (user,) = read_histories(policy.trained, None, None, [7])
    return explain(policy.trained, rule, user, 5, seen)


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
    assert {each.reason for each in by_seen} == {"the user has seen it"}
    assert [each.rank for each in by_seen] == sorted(each.rank for each in by_seen)
    tagged = explained(policy, DecisionRule(2.0, tag_window=2))
    last = [item for item, _ in tagged.rows[:2]]
    assert tagged.excluded
    for each in tagged.excluded:
        assert each.reason == "it shares a tag with one of the last 2 items"
        assert each.item_id % 5 in {item % 5 for item in last}
    assert not {card.item_id for card in tagged.cards} & {e.item_id for e in tagged.excluded}
    assert not explained(policy, DecisionRule(2.0)).excluded


def test_a_read_pasted_is_recommended_for(policy: Recommender) -> None:
    frame = read_pasted("3, 1\n\n5\n 7,0 ")
    assert frame.item_id.tolist() == ["3", "5", "7"]
    assert frame.reward.tolist() == [1, 0, 0]
    (user,) = read_histories(policy.trained, frame, None, None)
    found = explain(policy.trained, DecisionRule(2.0), user, 4, True)
    assert [str(item) for item, _ in found.rows] == ["7", "5", "3"]
    assert len(found.cards) == 4
    for text, message in (
        ("3, 1\n5, x", "line 2 of the history is '5, x'; write item_id"),
        ("3, nan", "line 1"),
        ("1\n" * 1001, "1,001 rows; paste at most 1,000"),
    ):
        with pytest.raises(InputError, match=message):
            read_pasted(text)
