"""Answers to requests are those of `recommend`, whoever else asks at the same time."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.served import (
    FULL,
    OBSERVED,
    as_frame,
    histories,
    observed_log,
    requests_of,
    responder,
)
from ucfrec import Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.errors import InputError
from ucfrec.logs.expressions import Expression
from ucfrec.logs.mapping import LogMapping
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.recommending.recommend import recommend
from ucfrec.recommending.requests import HistoryReader, Request, Row
from ucfrec.recommending.responder import Answer, Responder
from ucfrec.recommending.row_rewards import RowRewards
from ucfrec.runs.trained_policy import TrainedPolicy


def answered(by: Responder, requests: list[dict[str, object]]) -> pd.DataFrame:
    asked = [Request.model_validate(request) for request in requests]
    answers = by.answers(asked)
    assert all(isinstance(answer, Answer) for answer in answers), answers
    return as_frame(
        [a.as_dict(r.user_id) for a, r in zip(answers, asked, strict=True)]  # type: ignore[union-attr]
    )


def recommended(trained: TrainedPolicy, log: pd.DataFrame, k: int, **named: object) -> pd.DataFrame:
    mapping = OBSERVED if "observation" in log else LogMapping()
    batches = histories_of_frame(trained, log, mapping)
    return pd.concat(recommend(trained, batches, k, **named), ignore_index=True)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "rule",
    [
        None,
        FULL,
        DecisionRule(3.0, temperature=0.7, top_k=9),
        DecisionRule(3.0, explore=0.5, explore_top=12),
    ],
    ids=["own", "full", "drawn", "explores"],
)
@pytest.mark.parametrize("keep_seen", [False, True])
def test_answers_are_those_of_recommend(
    trained: TrainedPolicy, rule: DecisionRule | None, keep_seen: bool
) -> None:
    log = histories()
    named = {"rule": rule, "filter_seen": not keep_seen}
    expected = recommended(trained, log, 24, **named)
    by = responder(trained, k=24, **named)
    together = answered(by, requests_of(log))
    pd.testing.assert_frame_equal(together, expected, check_dtype=False, rtol=1e-5, atol=1e-6)
    alone = [answered(by, [request]) for request in requests_of(log)]
    pd.testing.assert_frame_equal(
        pd.concat(alone, ignore_index=True), expected, check_dtype=False, rtol=1e-5, atol=1e-6
    )


def test_requests_give_the_observations_that_logs_have(screened: TrainedPolicy) -> None:
    log = observed_log(histories())
    found = answered(responder(screened, k=24), requests_of(log))
    expected = recommended(screened, log, 24)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False, rtol=1e-5, atol=1e-6)


def test_each_request_has_its_own_k_and_candidates(trained: TrainedPolicy) -> None:
    log = histories(users=4)
    requests = requests_of(log)
    asked = [
        requests[0],
        {**requests[1], "k": 2},
        {**requests[2], "candidates": [5, 6, 7], "k": 9},
        {**requests[3], "candidates": ["5"], "k": 1},
    ]
    by = responder(trained, filter_seen=False, k=3)
    found = answered(by, asked)
    assert found.groupby("user_id").size().tolist() == [3, 2, 3, 1]
    for request in asked:
        user = request["user_id"]
        expected = recommended(
            trained,
            log[log.user_id == user],
            int(request.get("k", 3)),
            filter_seen=False,
            candidates=request.get("candidates"),
        )
        own = found[found.user_id == user].reset_index(drop=True)
        pd.testing.assert_frame_equal(own, expected, check_dtype=False, rtol=1e-5, atol=1e-6)


def test_a_user_may_begin_a_new_session(trained: TrainedPolicy) -> None:
    log, by = histories(users=6), responder(trained, k=24)
    asked = [{**each, "new_session": n % 2 == 0} for n, each in enumerate(requests_of(log))]
    goes_on, begins = (recommended(trained, log, 24, new_session=new) for new in (False, True))
    for request, found in zip(asked, by.answers([Request(**r) for r in asked]), strict=True):
        assert isinstance(found, Answer)
        same, other = (begins, goes_on) if request["new_session"] else (goes_on, begins)
        user = request["user_id"]
        scores = [each[each.user_id == user].score.to_numpy() for each in (same, other)]
        np.testing.assert_allclose(found.scores, scores[0], rtol=1e-5, atol=1e-6)
        assert not np.allclose(*scores, rtol=1e-3)


def test_a_request_id_gives_the_same_answer_and_another_draws_again(trained: TrainedPolicy) -> None:
    by = responder(trained, k=9, rule=DecisionRule(3.0, temperature=4.0))
    given = [Request(user_id=7, request_id=name) for name in ("a", "a", "b")] + [Request(user_id=7)]
    one, same, other, made = by.answers(given)
    assert isinstance(one, Answer)
    assert isinstance(same, Answer)
    assert one.items == same.items
    np.testing.assert_allclose(one.propensities, same.propensities, rtol=1e-5)
    assert isinstance(other, Answer)
    assert isinstance(made, Answer)
    assert one.items != other.items
    assert len({one.request_id, other.request_id, made.request_id}) == 3
    assert (one.run, one.rule) == (trained.fingerprint, by.rule.hash)
    (again,) = by.answers([Request(user_id=7, request_id=made.request_id)])
    assert isinstance(again, Answer)
    assert again.items == made.items


def test_a_user_without_a_history_is_answered(trained: TrainedPolicy) -> None:
    found = answered(responder(trained, k=4), [{"user_id": "nobody"}, {"user_id": 10**9}])
    one, other = (found[found.user_id == user] for user in ("nobody", 10**9))
    assert one.item_id.tolist() == other.item_id.tolist()
    assert len(one) == 4


def test_a_user_who_has_seen_everything_gets_nothing(trained: TrainedPolicy) -> None:
    rows = [{"item_id": n, "timestamp": 1_700_000_000_000 + n, "reward": 1} for n in range(24)]
    requests = [{"user_id": 1, "history": rows}, {"user_id": 2, "history": rows[:20]}]
    none, four = responder(trained).answers([Request.model_validate(r) for r in requests])
    assert isinstance(none, Answer)
    assert none[:3] == ([], [], [])
    assert isinstance(four, Answer)
    assert set(four.items) <= {20, 21, 22, 23}


def test_a_wrong_request_does_not_disturb_the_others(trained: TrainedPolicy) -> None:
    requests = requests_of(histories(users=3))
    wrong = [
        ({"user_id": 1, "candidates": [3, 999]}, r"1 of 2 candidates .* \(999\)"),
        ({"user_id": 1, "history": [{"item_id": "x", "timestamp": 1.7e12, "reward": 0}]}, r"\(x\)"),
        ({"user_id": 1, "history": [{"item_id": 1, "timestamp": 1.7e12}]}, "0 has no reward;"),
        ({"user_id": 1, "history": [{"item_id": 1, "timestamp": 5, "reward": 0}]}, "before 1971"),
        (
            {"user_id": 1, "history": [{"item_id": 1, "timestamp": 1.7e12, "reward": 2e12}]},
            "within",
        ),
    ]
    mixed = [wrong[0][0], requests[0], *(each for each, _ in wrong[1:]), requests[1]]
    answers = responder(trained).answers([Request.model_validate(r) for r in mixed])
    good = [answer for answer in answers if isinstance(answer, Answer)]
    assert len(good) == 2
    np.testing.assert_allclose(
        [*good[0].scores, *good[1].scores],
        answered(responder(trained), requests[:2]).score,
        rtol=1e-5,
    )
    errors = [answer for answer in answers if isinstance(answer, InputError)]
    for error, (_, message) in zip(errors, wrong, strict=True):
        with pytest.raises(InputError, match=message):
            raise error
    skipping = responder(trained, skip_unknown=True).answers([Request.model_validate(wrong[1][0])])
    assert isinstance(skipping[0], Answer)


def test_unknown_candidates_are_skipped_where_others_are_left(trained: TrainedPolicy) -> None:
    by = responder(trained, k=9, skip_unknown=True)
    some, none = by.answers(
        [Request(user_id=1, candidates=[5, 999]), Request(user_id=1, candidates=[999, "x"])]
    )
    assert isinstance(some, Answer)
    assert some.items == [5]
    assert isinstance(none, InputError)
    assert "2 of 2 candidates are items that the policy does not know" in str(none)


@pytest.mark.parametrize("value", [10**400, -(10**400), float("inf"), float("nan"), 2e12, "1"])
@pytest.mark.parametrize("reward", ["is_click", "1 * is_click"])
def test_feedback_that_is_no_reward_is_refused(reward: str, value: object) -> None:
    rewards = RowRewards(Expression(reward, "run.json"))
    assert rewards.of_rows([{"is_click": 1}]) == [1.0]
    with pytest.raises(InputError, match="history"):
        rewards.of_rows([{"is_click": value}])
    rewards.close()


def test_feedback_that_is_missing_in_all_rows_takes_the_default_of_the_expression() -> None:
    rewards = RowRewards(Expression("coalesce(revenue, 0) + 1", "run.json"))
    assert rewards.of_rows([{"revenue": None}, {"revenue": None}]) == [1.0, 1.0]
    assert rewards.of_rows([{"revenue": None}, {"revenue": 2.5}, {}]) == [1.0, 3.5, 1.0]
    with pytest.raises(InputError, match="has neither reward nor revenue"):
        rewards.of_rows([{"clicks": 1}])
    with pytest.raises(InputError, match="cannot be computed where revenue is VARCHAR") as refused:
        rewards.of_rows([{"revenue": "three"}])
    assert "run.json" not in str(refused.value), "a client is not told of files of the server"
    rewards.close()


@pytest.mark.parametrize("reward", ["click", "1 * click"])
def test_feedback_is_matched_in_any_case(reward: str) -> None:
    rewards = RowRewards(Expression(reward, "run.json"))
    assert rewards.of_rows([{"Click": 1}, {"click": 2}, {"CLICK": 3, "click": None}]) == [1, 2, 3]
    with pytest.raises(InputError, match="neither reward nor click"):
        rewards.of_rows([{"clicks": 1}])
    rewards.close()


def test_a_reward_that_is_computed_from_a_column_of_that_name_is_computed() -> None:
    rewards = RowRewards(Expression("1 - reward / 5", "run.json"))
    assert rewards.of_rows([{"reward": 5.0}, {"reward": 0.0}]) == [0.0, 1.0]
    with pytest.raises(InputError, match=r"history has no reward, which .* needs; give it"):
        rewards.of_rows([{"clicks": 1}])
    rewards.close()


def test_an_observation_that_is_infinite_in_single_precision_is_refused() -> None:
    reader = HistoryReader("last", False, 2, RowRewards(Expression("reward", "run.json")))
    row = {"item_id": 1, "timestamp": 1.7e12, "reward": 0, "observation": [1, -2.5]}
    (seen,) = reader.read([Row(**row)], 1).observations  # type: ignore[typeddict-item]
    assert seen.tolist() == [1.0, -2.5]
    with pytest.raises(InputError, match="numbers beyond"):
        reader.read([Row(**{**row, "observation": [1, -1e39]})], 1)  # type: ignore[typeddict-item]


def test_nothing_of_a_request_is_kept(trained: TrainedPolicy) -> None:
    by, requests = responder(trained), requests_of(histories(users=2))
    request = {"user_id": 100, "request_id": "a"}
    before = answered(by, [request])
    answered(by, requests)
    pd.testing.assert_frame_equal(answered(by, [request]), before)


def test_a_policy_of_vectors_and_a_wrong_k_are_refused(
    trained: TrainedPolicy, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="k is 0; give a whole number from 1 to 1,000"):
        responder(trained, k=0)
    assert repr(Recommender.load(trained.folder))
