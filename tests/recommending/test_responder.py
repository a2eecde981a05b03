"""Answers to requests are those of `recommend`, whoever else asks at the same time."""

import shutil
import threading
import time
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.logs import START
from tests.support.served import (
    FULL,
    OBSERVED,
    as_frame,
    histories,
    observed_log,
    recommend,
    request_of,
    requests_of,
    responder,
    trained_run,
    with_rule,
)
from ucfrec.acting.decision import DecisionRule
from ucfrec.errors import InputError
from ucfrec.logs.expressions import Expression
from ucfrec.logs.histories import frame_histories
from ucfrec.logs.mapping import LogMapping
from ucfrec.recommending import recommend as module
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.recommending.requests import HistoryReader, Request, Row, RowRewards
from ucfrec.recommending.responder import Answer, Responder, Served, arm_of, parse_split
from ucfrec.runs.promoted import POINTER, promote, promote_back
from ucfrec.runs.record import RunRecord
from ucfrec.runs.trained_policy import TrainedPolicy

REWARD = Expression("reward", "run.json")


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


with_rules = pytest.mark.parametrize(
    "rule",
    [
        *(None, FULL, replace(FULL, by_marginal_gain=True)),
        DecisionRule(1.0, reward_weight=3.0, tag_run=1),
        DecisionRule(3.0, temperature=0.7, top_k=9, explore=0.5, explore_top=12),
    ],
    ids=["own", "full", "in turn", "run", "drawn"],
)


@with_rules
@pytest.mark.parametrize("keep_seen", [False, True])
def test_answers_are_those_of_recommend(
    trained: TrainedPolicy, rule: DecisionRule | None, keep_seen: bool
) -> None:
    assert trained.reward_model is not None
    trained.reward_model.above.fill_(-1.0)
    log = histories()
    named = {"rule": rule, "filter_seen": not keep_seen}
    expected = recommended(trained, log, 24, **named)
    by = responder(trained, k=24, **named)
    together = answered(by, requests_of(log))
    alone = pd.concat([answered(by, [each]) for each in requests_of(log)], ignore_index=True)
    for found in (together, alone):
        pd.testing.assert_frame_equal(found, expected, check_dtype=False, rtol=1e-5, atol=1e-6)


def test_requests_give_the_observations_that_logs_have(observing: TrainedPolicy) -> None:
    log = observed_log(histories())
    found = answered(responder(observing, k=24), requests_of(log))
    expected = recommended(observing, log, 24)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False, rtol=1e-5, atol=1e-6)


def test_each_request_has_its_own_k_and_candidates(trained: TrainedPolicy) -> None:
    log = histories(users=4)
    given = ({}, {"k": 2}, {"candidates": [5, 6, 7], "k": 9}, {"candidates": ["5"], "k": 1})
    asked = [each | more for each, more in zip(requests_of(log), given, strict=True)]
    by = responder(trained, filter_seen=False, k=3)
    found = answered(by, asked)
    assert found.groupby("user_id").size().tolist() == [3, 2, 3, 1]
    for request in asked:
        user = request["user_id"]
        named = {"filter_seen": False, "candidates": request.get("candidates")}
        expected = recommended(trained, log[log.user_id == user], request.get("k", 3), **named)
        own = found[found.user_id == user].reset_index(drop=True)
        expected["request_id"] = own.request_id
        pd.testing.assert_frame_equal(own, expected, check_dtype=False, rtol=1e-5, atol=1e-6)


@with_rules
def test_candidates_of_a_large_catalogue_are_scored_without_the_others(
    trained: TrainedPolicy, rule: DecisionRule | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, by = np.random.default_rng(0), responder(trained, rule=rule)
    asked = requests_of(histories())
    for number, request in enumerate(asked):
        some = rng.integers(24, size=1 + number % 16).tolist()
        request |= {"request_id": str(number), "candidates": some if number % 4 else None}
    expected = answered(by, asked)
    monkeypatch.setattr(module, "_LARGE", 1)
    monkeypatch.setattr(module, "_SPARSE", 1)
    alone = pd.concat([answered(by, [each]) for each in asked], ignore_index=True)
    for found in (answered(by, asked), alone):
        pd.testing.assert_frame_equal(found, expected, check_dtype=False, rtol=1e-5, atol=1e-6)


@given(ids=st.lists(st.integers(-9, 30) | st.sampled_from([-(2**63), 2**63 - 1, "3", "99"])))
def test_candidates_are_a_set_of_ids(trained: TrainedPolicy, ids: list[int | str]) -> None:
    by = responder(trained, k=24, filter_seen=False, skip_unknown=True)
    every, some = by.answers([Request(user_id=1), Request(user_id=1, candidates=[*ids, 5])])
    assert some.items == [item for item in every.items if item in {*map(int, ids), 5}]


def test_a_user_may_begin_a_new_session(trained: TrainedPolicy) -> None:
    """As the request says, or else after a pause longer than the run's two hours."""
    log, by = histories(users=8), responder(trained, k=24)
    for n, (_, rows) in enumerate(log.groupby("user_id")):
        new, stated = bool(n % 2), None if n % 4 > 1 else bool(n % 2)
        late = new if stated is None else not new
        last = 1000 * round(time.time()) - 120 * 60_000 - (60_000 if late else -60_000)
        rows = rows.assign(timestamp=rows.timestamp - rows.timestamp.max() + last)
        (answer,) = by.answers([Request(**request_of(rows, new_session=stated))])
        same, other = (recommended(trained, rows, 24, new_session=b).score for b in (new, not new))
        np.testing.assert_allclose(answer.scores, same, rtol=1e-5, atol=1e-6)
        assert not np.allclose(same, other, rtol=1e-3)
    assert by.drift()["new_sessions"].value == 0.5


def test_a_request_id_gives_the_same_answer_and_another_draws_again(trained: TrainedPolicy) -> None:
    by = responder(trained, k=9, rule=DecisionRule(3.0, temperature=4.0))
    given = [Request(user_id=7, request_id=name) for name in ("a", "a", "b")] + [Request(user_id=7)]
    one, same, other, made = by.answers(given)
    assert one.items == same.items
    np.testing.assert_allclose(one.propensities, same.propensities, rtol=1e-5)
    assert one.items != other.items
    assert len({one.request_id, other.request_id, made.request_id}) == 3
    assert (one.run, one.rule) == (trained.fingerprint, by.rule.hash)
    (again,) = by.answers([Request(user_id=7, request_id=made.request_id)])
    assert again.items == made.items


def test_a_user_who_has_seen_everything_gets_nothing(trained: TrainedPolicy) -> None:
    rows = [{"item_id": n, "timestamp": 1_700_000_000_000 + n, "reward": 1} for n in range(24)]
    requests = [{"user_id": 1, "history": rows}, {"user_id": 2, "history": rows[:20]}]
    none, four = responder(trained).answers([Request.model_validate(r) for r in requests])
    assert none[:3] == ([], [], [])
    assert set(four.items) <= {20, 21, 22, 23}


def test_a_wrong_request_does_not_disturb_the_others(trained: TrainedPolicy) -> None:
    requests = requests_of(histories(users=3))
    wrong = [
        ({"user_id": 1, "candidates": [3, 999]}, r"1 of 2 named items .* \(999\)"),
        ({"user_id": 1, "history": [{"item_id": "x", "timestamp": 1.7e12, "reward": 0}]}, r"\(x\)"),
        ({"user_id": 1, "history": [{"item_id": 1, "timestamp": 1.7e12}]}, "0 has no reward;"),
        ({"user_id": 1, "history": [{"item_id": 1, "timestamp": 5, "reward": 0}]}, "before 1971"),
    ]
    mixed = [wrong[0][0], requests[0], *(each for each, _ in wrong[1:]), requests[1]]
    answers = responder(trained).answers([Request.model_validate(r) for r in mixed])
    scores = [score for answer in answers if isinstance(answer, Answer) for score in answer.scores]
    expected = answered(responder(trained), requests[:2]).score
    np.testing.assert_allclose(scores, expected, rtol=1e-5)
    errors = [answer for answer in answers if isinstance(answer, InputError)]
    for error, (_, message) in zip(errors, wrong, strict=True):
        with pytest.raises(InputError, match=message):
            raise error
    by = responder(trained, k=9, skip_unknown=True)
    unknown = [Request(user_id=1, candidates=given) for given in ([5, 999], [999, "x"])]
    skipping, some, none = by.answers([Request.model_validate(wrong[1][0]), *unknown])
    assert isinstance(skipping, Answer)
    assert some.items == [5]
    assert "2 of 2 named items are not known to the policy" in str(none)


@pytest.mark.parametrize("value", [10**400, -(10**400), float("inf"), float("nan"), 2e12, "1"])
@pytest.mark.parametrize("reward", ["is_click", "1 * is_click"])
def test_feedback_that_is_no_reward_is_refused(reward: str, value: object) -> None:
    with closing(RowRewards(Expression(reward, "run.json"))) as rewards:
        assert rewards.of_rows([{"is_click": 1}]) == [1.0]
        with pytest.raises(InputError, match="history"):
            rewards.of_rows([{"is_click": value}])


ANY_CASE = [{"Click": 1}, {"click": 2}, {"CLICK": 3, "click": None}]
REVENUE = "coalesce(revenue, 0) + 1"


@pytest.mark.parametrize(
    ("reward", "rows", "found", "wrong", "message"),
    [
        (REVENUE, [{"revenue": None}] * 2, [1, 1], {"clicks": 1}, "neither reward nor revenue"),
        (REVENUE, [{}, {"revenue": 2.5}], [1, 3.5], {"revenue": "3"}, "where revenue is VARCHAR"),
        ("click", ANY_CASE, [1, 2, 3], {"clicks": 1}, "neither reward nor click"),
        ("1 * click", ANY_CASE, [1, 2, 3], {"clicks": 1}, "neither reward nor click"),
        ("1 - reward / 5", [{"reward": 5.0}], [0], {"clicks": 1}, "history has no reward, which"),
        ("1", [{"item_id": 5}, {"click": 2}, {}], [1, 1, 1], {"reward": "3"}, "the reward is '3'"),
    ],
)
def test_rewards_are_computed_from_feedback(
    reward: str, rows: list[Any], found: list[float], wrong: dict[str, object], message: str
) -> None:
    with closing(RowRewards(Expression(reward, "run.json"))) as rewards:
        assert rewards.of_rows(rows) == found
        with pytest.raises(InputError, match=message) as refused:
            rewards.of_rows([wrong])
    assert "run.json" not in str(refused.value)  # a client is not told of files of the server


def test_an_observation_that_is_infinite_in_single_precision_is_refused() -> None:
    reader = HistoryReader("last", False, 2, RowRewards(REWARD))
    row = {"item_id": 1, "timestamp": 1.7e12, "reward": 0, "observation": [1, -2.5]}
    (seen,) = reader.read([Row(**row)], 1).observations  # type: ignore[typeddict-item]
    assert seen.tolist() == [1.0, -2.5]
    with pytest.raises(InputError, match="numbers beyond"):
        reader.read([Row(**{**row, "observation": [1, -1e39]})], 1)  # type: ignore[typeddict-item]


def test_rows_of_a_list_are_read_in_its_order() -> None:
    rng, reader = np.random.default_rng(0), HistoryReader("last", False, 0, RowRewards(REWARD))
    log = pd.DataFrame({"item_id": rng.permutation(20), "position": rng.permutation(20) + 1})
    log = log.assign(reward=0.0, timestamp=START + np.repeat([5, 9, 9, 9], 5))
    (batch,) = frame_histories(log.assign(user_id=1), LogMapping(), "reward", 100)
    expected = log.sort_values(["timestamp", "position"]).item_id.tolist()
    rows = log.to_dict("records")
    assert reader.read(rows, 1).item_ids.tolist() == batch.item_ids.tolist() == expected


# Runs that share the users, and a run that is replaced as the server runs.


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs `run` and `other`, of which the first is promoted."""
    folder = tmp_path_factory.mktemp("served")
    trained_run(folder)
    shutil.copytree(folder / "run", folder / "other")
    promote(folder / "run")
    return folder


def wait_for(served: Served, name: str) -> None:
    deadline = time.monotonic() + 60
    while served.described()["name"] != name:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def make(run: Path) -> Responder:
    """`other` draws, so that its rule has another hash."""
    trained = TrainedPolicy.load(run)
    rule = with_rule(trained, temperature=0.0 if run.name == "run" else 1.0)
    return responder(trained, k=2, rule=rule)


def answers_of(served: Served, users: int = 200) -> list[Answer]:
    requests = [Request(user_id=user, request_id="r") for user in range(users)]
    found = [each for each in served.answers(requests) if isinstance(each, Answer)]
    assert len(found) == users
    return found


def test_users_are_divided_by_their_shares_and_stay_where_they_are(folder: Path) -> None:
    with closing(Served(make, folder, {"run": 0.75, "other": 0.25})) as served:
        found = answers_of(served, 2000)
        shares = Counter(answer.arm for answer in found)
        assert shares["other"] / 2000 == pytest.approx(0.25, abs=0.04)
        arms = served.described()["arms"]
        for user, answer in enumerate(found):
            assert answer.arm == ("run", "other")[arm_of(user, (0.75, 0.25))]
            assert answer.rule == arms[answer.arm]["rule_hash"]
        assert [each.arm for each in answers_of(served, 50)] == [each.arm for each in found[:50]]


@given(user=st.integers(0, 2**40), share=st.floats(0.01, 0.98))
def test_a_larger_share_keeps_the_users_that_it_had(user: int, share: float) -> None:
    assert arm_of(user, (1 - share, share)) == arm_of(str(user), (1 - share, share))
    if arm_of(user, (share, 1 - share)) == 0:
        assert arm_of(user, (share + 0.01, 0.99 - share)) == 0


@pytest.mark.parametrize("given", ["a", "a=x", "a=0.5", "a=0.5,b=0.6", "a=1.5,b=-0.5"])
def test_shares_that_are_none_are_refused(given: str) -> None:
    with pytest.raises(InputError, match="shares"):
        parse_split(given)
    assert parse_split("a=0.9, b=0.1") == {"a": 0.9, "b": 0.1}


def test_a_promoted_run_answers_between_two_batches(folder: Path) -> None:
    with closing(Served(make, folder, None)) as served:
        served.follow(0.01)
        rules, ended = [], threading.Event()

        def ask() -> None:
            while not ended.is_set():
                rules.append({answer.rule for answer in answers_of(served, 20)})

        asking = threading.Thread(target=ask)
        asking.start()
        old = served.described()["rule_hash"]
        promote(folder / "other", force=True)
        wait_for(served, "other")
        new = served.described()["rule_hash"]
        promote_back(folder)
        wait_for(served, "run")
        ended.set()
        asking.join()
    assert old != new
    # No batch was answered by two runs, and none failed.
    assert all(len(each) == 1 for each in rules)
    assert {old} in rules


@pytest.mark.parametrize("file", ["policy/best.safetensors", "run.json"])
def test_a_run_that_cannot_be_used_changes_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], file: str
) -> None:
    broken = shutil.copytree(folder / "run", folder / "broken", dirs_exist_ok=True)
    with closing(Served(make, folder, None)) as served:
        promote(broken, force=True)
        content = (broken / file).read_bytes()
        (broken / file).unlink()
        if file == "run.json":  # another run under the name
            RunRecord.read(folder / "run").copy_with(fingerprint="another store").write(broken)
        served.check()
        described = served.described()
        assert described["name"] == "run"
        assert described["refused"]["name"] == "broken"
        answers_of(served)
        (broken / file).write_bytes(content)
        served.check()
        assert served.described()["name"] == "run"
        promote(broken)
        served.check()
        assert served.described()["name"] == "broken"
        promote_back(folder)
        served.check()
    why = "is not the run that was promoted" if file == "run.json" else "best.safetensors"
    assert f"broken is not used: {broken}" in (said := capsys.readouterr().err)
    assert why in said


@pytest.mark.parametrize("damage", ["{", '{"files": {}, "current": "../other"}', "folder"])
def test_a_damaged_pointer_file_is_told_of_once_and_followed_again(
    folder: Path, capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    pointer = folder / POINTER
    whole = pointer.read_bytes()
    with closing(Served(make, folder, None)) as served:
        served.follow(0.01)
        if damage == "folder":
            pointer.unlink()
            pointer.mkdir()
        else:  # whole at once, as the thread may look at any moment
            (folder / "damaged").write_text(damage)
            (folder / "damaged").replace(pointer)
        time.sleep(0.3)
        assert served.described()["refused"]["name"] == POINTER
        answers_of(served)
        if damage == "folder":
            pointer.rmdir()
        (folder / "whole").write_bytes(whole)
        (folder / "whole").replace(pointer)
        promote(folder / "other", force=True)
        wait_for(served, "other")
        promote_back(folder)
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "answers from" not in line]
    assert str(folder) in said


def test_a_run_made_again_under_its_name_replaces_the_one_that_answers(folder: Path) -> None:
    with closing(Served(make, folder, None)) as served:
        before = served.trained.fingerprint
        (folder / "run").rename(folder / "kept")
        shutil.copytree(folder / "other", folder / "run")
        record = RunRecord.read(folder / "run").copy_with(fingerprint="another store")
        record.write(folder / "run")
        try:
            served.check()
            assert served.trained.fingerprint == before
            with pytest.raises(InputError, match="run is not the run that was promoted: promoted"):
                Served(make, folder, None)
            promote(folder / "run", force=True)
            served.check()
            assert served.described()["run"] != before
        finally:
            shutil.rmtree(folder / "run")
            (folder / "kept").rename(folder / "run")
            promote(folder / "run", force=True)


def test_unknown_items_and_users_are_counted(trained: TrainedPolicy) -> None:
    by = responder(trained, skip_unknown=True)
    rows = [{"item_id": item, "timestamp": 1.7e12, "reward": 1.0} for item in (0, 1, 999)]
    users = (100, "nobody")
    by.answers([Request.model_validate({"user_id": user, "history": rows}) for user in users])
    found = by.drift()
    assert found["unknown_items"].value == pytest.approx(1 / 3)
    assert found["unknown_users"].value == pytest.approx(1 / 2)
