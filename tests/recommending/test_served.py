"""Runs that share the users, and a run that is replaced as the server runs."""

import shutil
import threading
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.served import responder, trained_run, with_rule
from ucfrec.errors import InputError
from ucfrec.recommending.requests import Request
from ucfrec.recommending.responder import Answer, Responder
from ucfrec.recommending.served import Served, arm_of, parse_split
from ucfrec.runs.promoted import POINTER, promote, promote_back
from ucfrec.runs.record import RunRecord
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs `run` and `other`, of which the first is promoted."""
    folder = tmp_path_factory.mktemp("served")
    trained_run(folder)
    shutil.copytree(folder / "run", folder / "other")
    promote(folder / "run")
    return folder


def make(run: Path) -> Responder:
    """`other` draws, so that its rule has another hash."""
    trained = TrainedPolicy.load(run)
    return responder(
        trained, k=2, rule=with_rule(trained, temperature=0.0 if run.name == "run" else 1.0)
    )


def answers(served: Served, users: int = 200) -> list[Answer]:
    requests = [Request(user_id=user, request_id="r") for user in range(users)]
    found = [each for each in served.answers(requests) if isinstance(each, Answer)]
    assert len(found) == users
    return found


def test_users_are_divided_by_their_shares_and_stay_where_they_are(folder: Path) -> None:
    with closing(Served(make, folder, {"run": 0.75, "other": 0.25})) as served:
        found = answers(served, 2000)
        shares = Counter(answer.arm for answer in found)
        assert shares["other"] / 2000 == pytest.approx(0.25, abs=0.04)
        arms = served.described()["arms"]
        for user, answer in enumerate(found):
            assert answer.arm == ("run", "other")[arm_of(user, (0.75, 0.25))]
            assert answer.rule == arms[answer.arm]["rule_hash"]
        assert [each.arm for each in answers(served, 50)] == [each.arm for each in found[:50]]


@given(user=st.integers(0, 2**40), share=st.floats(0.01, 0.98))
def test_a_larger_share_keeps_the_users_that_it_had(user: int, share: float) -> None:
    assert arm_of(user, (1 - share, share)) == arm_of(str(user), (1 - share, share))
    if arm_of(user, (share, 1 - share)) == 0:
        assert arm_of(user, (share + 0.01, 0.99 - share)) == 0


@pytest.mark.parametrize("given", ["a", "a=x", "a=0.5", "a=0.5,b=0.6", "a=1.5,b=-0.5"])
def test_shares_that_are_none_are_refused(given: str) -> None:
    with pytest.raises(InputError, match="--split"):
        parse_split(given)
    assert parse_split("a=0.9, b=0.1") == {"a": 0.9, "b": 0.1}


def test_a_promoted_run_answers_between_two_batches(folder: Path) -> None:
    with closing(Served(make, folder, None)) as served:
        served.follow(0.01)
        rules, ended = [], threading.Event()

        def ask() -> None:
            while not ended.is_set():
                rules.append({answer.rule for answer in answers(served, 20)})

        asking = threading.Thread(target=ask)
        asking.start()
        old = served.described()["rule_hash"]
        promote(folder / "other", force=True)
        deadline = time.monotonic() + 60
        while served.described()["name"] != "other" and time.monotonic() < deadline:
            time.sleep(0.01)
        new = served.described()["rule_hash"]
        promote_back(folder)
        while served.described()["name"] != "run" and time.monotonic() < deadline:
            time.sleep(0.01)
        ended.set()
        asking.join()
    assert old != new
    # No batch was answered by two runs, and none failed.
    assert all(len(each) == 1 for each in rules)
    assert {old} in rules


def test_a_run_that_cannot_be_used_changes_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder / "run", folder / "broken")
    with closing(Served(make, folder, None)) as served:
        promote(folder / "broken", force=True)
        weights = folder / "broken" / "policy" / "best.safetensors"
        content = weights.read_bytes()
        weights.unlink()
        served.check()
        described = served.described()
        assert described["name"] == "run"
        assert described["refused"]["name"] == "broken"
        answers(served)
        weights.write_bytes(content)
        served.check()
        assert served.described()["name"] == "run"
        promote(folder / "broken")
        served.check()
        described = served.described()
        assert described["name"] == "broken"
        assert "refused" not in described
        promote_back(folder)
        served.check()
    assert "broken is not used" in capsys.readouterr().err


@pytest.mark.parametrize("damage", ["{", '{"files": {}, "current": "../other"}', "folder"])
def test_a_damaged_pointer_file_is_told_of_once_and_followed_again(
    folder: Path, capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    pointer = folder / POINTER
    whole = pointer.read_bytes()
    with closing(Served(make, folder, None)) as served:
        served.follow(0.01)
        pointer.unlink()
        if damage == "folder":
            pointer.mkdir()
        else:
            pointer.write_text(damage)
        time.sleep(0.3)
        assert served.described()["refused"]["name"] == POINTER
        answers(served)
        if damage == "folder":
            pointer.rmdir()
        pointer.write_bytes(whole)
        promote(folder / "other", force=True)
        deadline = time.monotonic() + 60
        while served.described()["name"] != "other" and time.monotonic() < deadline:
            time.sleep(0.01)
        assert served.described()["name"] == "other"
        promote_back(folder)
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "answers from" not in line]
    assert str(folder) in said


def test_a_run_that_is_made_again_under_its_name_replaces_the_one_that_answers(
    folder: Path,
) -> None:
    with closing(Served(make, folder, None)) as served:
        before = served.trained.fingerprint
        (folder / "run").rename(folder / "kept")
        shutil.copytree(folder / "other", folder / "run")
        record = RunRecord.read(folder / "run").copy_with(fingerprint="another store")
        record.write(folder / "run")
        try:
            served.check()
            assert served.trained.fingerprint == before
            promote(folder / "run", force=True)
            served.check()
            assert served.described()["run"] != before
        finally:
            shutil.rmtree(folder / "run")
            (folder / "kept").rename(folder / "run")
            promote(folder / "run", force=True)


def test_a_folder_without_a_promoted_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no run in it was promoted"):
        Served(make, tmp_path, None)


def test_unknown_items_and_users_are_counted(folder: Path) -> None:
    trained = TrainedPolicy.load(folder / "run")
    by = responder(trained, skip_unknown=True)
    now = 1_700_000_000_000
    rows = [{"item_id": item, "timestamp": now, "reward": 1.0} for item in (0, 1, 999)]
    requests = [{"user_id": user, "history": rows} for user in (100, "nobody")]
    by.answers([Request.model_validate(each) for each in requests])
    found = by.drift()
    assert found["unknown_items"].value == pytest.approx(1 / 3)
    assert found["unknown_users"].value == pytest.approx(1 / 2)
