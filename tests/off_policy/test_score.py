"""Scores of logged choices: probabilities, and what the policy would see when acting."""

import re
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.off_policy.conftest import Read
from tests.support.replay import replayed
from tests.support.served import recommend
from ucfrec.acting.decision import DecisionRule
from ucfrec.commands.cli import main
from ucfrec.errors import InputError, InputNote
from ucfrec.files.record import CARD
from ucfrec.logs.mapping import LogMapping
from ucfrec.off_policy.evaluate import collect_steps, evaluate_off_policy
from ucfrec.off_policy.models import make_inputs
from ucfrec.off_policy.score import (
    LoggedSessions,
    read_logged_sessions,
    score,
    score_steps,
    share_seen,
)
from ucfrec.recommending.histories import histories_of_frame
from ucfrec.runs.record import store_of
from ucfrec.runs.trained_policy import TrainedPolicy

RULE = DecisionRule(7.5, temperature=1.0)
RULES = {
    "drawn": RULE,
    "best": DecisionRule(7.5),
    "minimum": DecisionRule(1.5, minimum_target=1.0, temperature=0.5),
    "unseen": DecisionRule(7.5, temperature=2.0, top_k=4, exclude_seen=True),
}


@pytest.mark.parametrize("rule", RULES)
def test_scores_are_an_actors(trained: TrainedPolicy, logged: LoggedSessions, rule: str) -> None:
    frame = pd.concat(score(trained, logged, RULES[rule]))
    numbers = {item: number for number, item in enumerate(trained.item_ids)}
    assert frame.session.nunique() > 300
    longest = frame.groupby("session").size().nlargest(10).index
    for session in longest:
        rows = frame[frame.session == session]
        items = [numbers[item] for item in rows.item_id]
        thought = replayed(trained, RULES[rule], items, list(rows.reward)).numpy()[:-1]
        chosen = thought[np.arange(len(items)), items]
        np.testing.assert_allclose(rows.probability, chosen, rtol=1e-4)
        np.testing.assert_array_equal(rows.greedy_item_id, trained.item_ids[thought.argmax(1)])
        if rule == "drawn":
            np.testing.assert_array_equal(rows["rank"], 1 + (thought > chosen[:, None]).sum(1))


def test_rows_are_the_logs(
    log: pd.DataFrame, trained: TrainedPolicy, logged: LoggedSessions
) -> None:
    frame = pd.concat(score(trained, logged, RULE), ignore_index=True)
    columns = "user_id session timestamp item_id reward propensity probability rank greedy_item_id"
    assert list(frame.columns) == columns.split()
    log = log.sort_values(["user_id", "timestamp"])
    for name in ("user_id", "item_id", "timestamp", "reward"):
        np.testing.assert_array_equal(frame[name], log[name])
    np.testing.assert_allclose(frame.propensity, 1 / 30)
    gaps = (log.timestamp.diff() > 20 * 60_000) | (log.user_id.diff() != 0)
    np.testing.assert_array_equal(frame.session, gaps.cumsum() - 1)
    assert 10**6 in set(frame.user_id)
    assert ((frame["rank"] == 1) == (frame.greedy_item_id == frame.item_id)).all()


def test_nothing_later_is_looked_at(log: pd.DataFrame, trained: TrainedPolicy, read: Read) -> None:
    """Rewards and items from a step on, changed: it is scored as before."""
    log = log.sort_values(["user_id", "timestamp"])
    gaps = (log.timestamp.diff() > 20 * 60_000) | (log.user_id.diff() != 0)
    later = log.groupby(gaps.cumsum()).cumcount() >= 1
    changed = log.assign(
        reward=np.where(later, 1 - log.reward, log.reward),
        item_id=np.where(later, (log.item_id + 7) % 30, log.item_id),
    )
    thought = []
    for rows in (log, changed):
        with read(rows) as logged:
            _, steps = logged.store.all_steps()
            batches = score_steps(trained, logged.store, logged.rows, RULE)
            thought.append(torch.cat([b.log_probabilities for b in batches]).numpy()[steps <= 1])
    np.testing.assert_allclose(*thought, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("greedy", [False, True])
def test_models_see_the_policy(
    trained: TrainedPolicy, logged: LoggedSessions, greedy: bool
) -> None:
    rule = replace(RULE, temperature=0.0) if greedy else RULE
    frame = pd.concat(score(trained, logged, RULE))
    steps = collect_steps(trained, logged, rule, seed=0)[0]
    certain = (frame.greedy_item_id == frame.item_id).astype(float)
    np.testing.assert_allclose(steps.target, certain if greedy else frame.probability, rtol=1e-5)
    np.testing.assert_array_equal(steps.session, frame.session)
    if greedy:
        # Where the policy would show the logged item, q and v ask the same.
        same = certain.to_numpy() == 1
        np.testing.assert_allclose(steps.model.q[same], steps.model.v[same], rtol=1e-3, atol=1e-5)
        assert not np.allclose(steps.model.q, steps.model.v, atol=1e-3)


def test_features_are_means_over_items(trained: TrainedPolicy, logged: LoggedSessions) -> None:
    batch = next(score_steps(trained, logged.store, logged.rows, RULE))
    at_policy = make_inputs(trained, batch)[2].features()[1]
    probabilities = batch.log_probabilities.exp().numpy()
    mean = np.zeros(at_policy.shape)
    for item in range(probabilities.shape[1]):
        shown = torch.full_like(batch.items, item)
        target, _, seen = make_inputs(trained, replace(batch, items=shown))
        np.testing.assert_allclose(target, probabilities[:, item], rtol=1e-6)
        mean += probabilities[:, item, None] * seen.features()[0]
    np.testing.assert_allclose(at_policy, mean, rtol=1e-4, atol=1e-5)


def test_unknown_items_are_counted(log: pd.DataFrame, trained: TrainedPolicy, read: Read) -> None:
    strange = log.head(4).assign(item_id=[991, 992, 993, 993])
    with read(pd.concat([log, strange])) as logged:
        assert logged.report["dropped"]["unknown_item"] == 4
        assert sum(map(len, score(trained, logged, RULE))) == len(log)
    for rows, keep_unknown, says in (
        (strange, False, r"no row is left \(4 rows: item is not in the store"),
        (strange, True, r"in all 4 rows the item is not in the store"),
    ):
        with pytest.raises(InputError, match=says), read(rows, keep_unknown):
            pass


def test_unknown_items_may_stay_with_no_probability(
    log: pd.DataFrame, trained: TrainedPolicy, logged: LoggedSessions, read: Read
) -> None:
    """Every third row has a new item, of probability 0; rows before it are evaluated as usual."""
    new = np.arange(len(log)) % 3 == 0
    before = collect_steps(trained, logged, RULE, seed=0)[0]
    with read(log.assign(item_id=np.where(new, 999, log.item_id)), keep=True) as kept:
        unknown = kept.store.step_values("item", *kept.store.all_steps()) < 0
        assert kept.unknown_items == unknown.sum() == new.sum()
        assert kept.report["dropped"]["unknown_item"] == 0
        steps = collect_steps(trained, kept, RULE, seed=0)[0]
    assert (steps.target[unknown] == 0).all()
    assert (steps.weights[unknown] == 0).all()
    untouched = ~unknown
    for first, last in zip(steps.first, steps.last, strict=True):
        untouched[first : last + 1] = np.logical_and.accumulate(~unknown[first : last + 1])
    assert untouched.sum() > 300
    np.testing.assert_allclose(steps.target[untouched], before.target[untouched], rtol=1e-4)


def test_logs_of_users_the_run_does_not_know_are_noted(log: pd.DataFrame, read: Read) -> None:
    users = log.user_id.nunique()
    padded = log.assign(user_id=log.user_id.map("{:07}".format))
    # Fewer than 20 users, or a tenth of known ones, say nothing.
    few = padded[padded.user_id.isin(padded.user_id.unique()[:19])]
    known = log.user_id.isin(log.user_id.unique()[: users // 8])
    some = padded.assign(user_id=padded.user_id.where(~known, log.user_id.map(str)))
    for each, noted in ((padded, True), (few, False), (some, False)):
        with warnings.catch_warnings(record=True) as said, read(each, keep=True):
            pass
        found = [str(note.message) for note in said if note.category is InputNote]
        assert [f"{users} of {users} users are not among" in s for s in found] == [True] * noted


@pytest.mark.parametrize(("duplicates", "kept"), [("lowest", min), ("highest", max)])
def test_rows_that_repeat_count_as_in_the_training_log(
    log: pd.DataFrame,
    trained: TrainedPolicy,
    tmp_path: Path,
    duplicates: str,
    kept: Callable[..., float],
) -> None:
    twice = pd.concat([log, log.assign(reward=kept(-1.0, 2.0)), log.assign(reward=0.5)])
    twice.to_parquet(tmp_path / "twice.parquet")
    data = trained.record.data.model_copy(update={"duplicates": duplicates})
    alike = replace(trained, record=trained.record.copy_with(data=data))
    with read_logged_sessions(alike, [tmp_path / "twice.parquet"], LogMapping()) as logged:
        assert set(pd.concat(score(alike, logged, RULE)).reward) == {kept(-1.0, 2.0)}


@pytest.mark.parametrize(("pause", "new_session"), [(60_000, False), (3_600_000, True)])
def test_items_that_users_have_seen_are_excluded_as_they_were_when_serving(
    folder: Path, trained: TrainedPolicy, read: Read, pause: int, new_session: bool
) -> None:
    """Two rounds of serving: what was seen is in the store of the run, or in the scored log."""
    rule = DecisionRule(trained.rule.target, temperature=1.0)
    before, served = pd.read_parquet(folder / "train.parquet"), []
    before = before[before.groupby("user_id").item_id.transform("nunique") < 28]
    for _ in range(2):
        batches = histories_of_frame(trained, before, LogMapping())
        found = pd.concat(recommend(trained, batches, 1, rule=rule, new_session=new_session))
        last = before.groupby("user_id").timestamp.max()
        rows = found[["user_id", "item_id", "propensity"]].assign(reward=0.0, excludes_seen=True)
        served.append(rows.assign(timestamp=rows.user_id.map(last) + pause))
        before = pd.concat([before, served[-1]])
    log = pd.concat(served).sort_values(["user_id", "timestamp"])
    with read(log.drop(columns="excludes_seen")) as logged:
        whole = pd.concat(score(trained, logged, rule))
    with read(log) as logged:
        filtered = pd.concat(score(trained, logged, rule))
        steps = collect_steps(trained, logged, rule, 0)[0]
    np.testing.assert_allclose(filtered.probability, log.propensity, rtol=1e-4)
    np.testing.assert_allclose(steps.target, log.propensity, rtol=1e-4)
    assert (whole.probability < 0.99 * log.propensity.to_numpy()).any()
    assert (whole.probability <= 1.0001 * log.propensity.to_numpy()).all()


def test_the_share_of_rows_seen_in_training(
    folder: Path,
    log: pd.DataFrame,
    trained: TrainedPolicy,
    read: Read,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ucfrec.episodes.view._BATCH_STEPS", 100)
    train = pd.read_parquet(folder / "train.parquet").sort_values("timestamp")
    for seen, expected in ((0, 0.0), (300, 0.5)):
        with read(pd.concat([train.head(seen), log.head(600 - seen)])) as logged:
            assert share_seen(trained, logged.store) == pytest.approx(expected, abs=0.01)
    # The last tenth of the training log is its test split, which the run never saw.
    with read(train, keep=True) as logged:
        rule = DecisionRule(5.0, temperature=1.0)
        evaluated = evaluate_off_policy(trained, logged, rule=rule, seed=0)
    assert not evaluated.verdict.lift.is_reliable
    assert "90% of the rows were seen in training" in evaluated.verdict.reasons[0]
    assert evaluated.rows[0]["seen_in_training"] == pytest.approx(0.9, abs=0.01)


def test_a_refit_has_seen_the_test_split_too(
    folder: Path, trained: TrainedPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, log, again = folder / "store", folder / "train.parquet", tmp_path / "refit"
    assert main(["train", str(store), "--out", str(again), "--refit", str(folder / "run")]) == 0
    held_out = pd.read_parquet(log).sort_values("timestamp").tail(50)
    held_out.to_parquet(tmp_path / "held-out.parquet")
    files = [tmp_path / "held-out.parquet"]
    with read_logged_sessions(trained, files, LogMapping()) as logged:
        assert share_seen(trained, logged.store) == 0
        assert share_seen(TrainedPolicy.load(again), logged.store) == 1
    assert f"next: ucfrec ope {again} LOGS, its" in capsys.readouterr().out
    assert main(["rank", str(folder / "run"), str(again), str(files[0])]) == 0
    said = re.findall("warning: (.*): (.*) of the rows were seen", capsys.readouterr().out)
    assert said == [(str(again), "100%")]
    assert "100% of the rows were seen in training" in (again / CARD).read_text()


def test_a_run_that_was_moved_with_its_store_finds_it(
    folder: Path, trained: TrainedPolicy, logged: LoggedSessions, tmp_path: Path
) -> None:
    for name in ("run", "store"):
        shutil.copytree(folder / name, tmp_path / name)
    for store in (tmp_path / "gone", tmp_path / "store"):
        places = {"store": str(store), "store_from_run": "../gone"}
        moved = replace(trained, record=trained.record.copy_with(**places))
        assert (share_seen(moved, logged.store) is None) is (store.name == "gone")
    record = trained.record.copy_with(store=str(tmp_path / "gone"))
    assert store_of(tmp_path / "run", record).path == (tmp_path / "store").resolve()
    (tmp_path / "store").rename(tmp_path / "elsewhere")
    assert store_of(tmp_path / "run", record) is None
    assert store_of(tmp_path / "run", trained.record) is not None
