"""Rows that a run was trained on are noticed where it is evaluated on them."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from ucfrec.acting.decision import DecisionRule
from ucfrec.commands.cli import main
from ucfrec.files.record import CARD
from ucfrec.logs import LogMapping
from ucfrec.off_policy.evaluate import evaluate_off_policy
from ucfrec.off_policy.score import logged_sessions
from ucfrec.off_policy.training_rows import share_seen
from ucfrec.runs.record import store_of
from ucfrec.runs.trained_policy import TrainedPolicy


@pytest.mark.parametrize(("seen", "expected"), [(0, 0.0), (300, 0.5)])
def test_the_share_of_rows_seen_in_training(
    folder: Path,
    trained: TrainedPolicy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    seen: int,
    expected: float,
) -> None:
    monkeypatch.setattr("ucfrec.episodes.view._BATCH_STEPS", 100)
    train = pd.read_parquet(folder / "train.parquet").sort_values("timestamp")
    rest = pd.read_parquet(folder / "rest.parquet").head(600 - seen)
    # The last tenth of the training log is its test split, which the run never saw.
    pd.concat([train.head(seen), rest]).to_parquet(tmp_path / "log.parquet")
    with logged_sessions(trained, [tmp_path / "log.parquet"], LogMapping()) as logged:
        assert share_seen(trained, logged.store) == pytest.approx(expected, abs=0.01)


def test_judging_by_the_training_log_is_refused(folder: Path, trained: TrainedPolicy) -> None:
    log = folder / "train.parquet"
    with logged_sessions(trained, [log], LogMapping(), keep_unknown=True) as logged:
        rule = DecisionRule(5.0, temperature=1.0)
        evaluated = evaluate_off_policy(trained, logged, rule=rule, seed=0)
    assert not evaluated.verdict.reliable
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
    with logged_sessions(trained, files, LogMapping()) as logged:
        assert share_seen(trained, logged.store) == 0
        assert share_seen(TrainedPolicy.load(again), logged.store) == 1
    capsys.readouterr()
    assert main(["rank", str(folder / "run"), str(again)]) == 2
    assert f"{again} is a refit" in capsys.readouterr().err
    assert main(["rank", str(folder / "run"), str(again), str(files[0])]) == 0
    said = re.findall("warning: (.*): (.*) of the rows were seen", capsys.readouterr().out)
    assert said == [(str(again), "100%")]
    assert "100% of the rows were seen in training" in (again / CARD).read_text()


def test_without_the_training_store_nothing_is_known(
    folder: Path, trained: TrainedPolicy, tmp_path: Path
) -> None:
    shutil.copytree(folder / "store", tmp_path / "store")
    for store in (tmp_path / "gone", tmp_path / "store"):
        places = {"store": str(store), "store_from_run": "../gone"}
        moved = replace(trained, record=trained.record.copy_with(**places))
        with logged_sessions(trained, [folder / "rest.parquet"], LogMapping()) as logged:
            assert (share_seen(moved, logged.store) is None) is (store.name == "gone")


def test_a_run_that_was_moved_with_its_store_finds_it(
    folder: Path, trained: TrainedPolicy, tmp_path: Path
) -> None:
    for name in ("run", "store"):
        shutil.copytree(folder / name, tmp_path / name)
    record = trained.record.copy_with(store=str(tmp_path / "gone"))
    found = store_of(tmp_path / "run", record)
    assert found is not None
    assert found.path == (tmp_path / "store").resolve()
    (tmp_path / "store").rename(tmp_path / "elsewhere")
    assert store_of(tmp_path / "run", record) is None
    assert store_of(tmp_path / "run", trained.record) is not None
