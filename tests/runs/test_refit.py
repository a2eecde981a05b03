"""Refits: the run acts by weights that have seen all rows; the test split by those before."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.recommending.test_recommend import random_log
from tests.support.logs import store_of
from ucfrec import EpisodeStore
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.off_policy.score import held_out_sessions
from ucfrec.runs.record import REFIT, RunRecord
from ucfrec.runs.refit import refit_within
from ucfrec.runs.trained_policy import TrainedPolicy

TINY = ["train.steps=40", "train.validate_every=20", "policy.dim=8", "policy.context=4"]
SETS = [word for each in (*TINY, "train.learning_rate=0.01") for word in ("--set", each)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refit")
    store_of(random_log(), folder, reward="reward", session_by="user")
    assert main(["train", str(folder / "store"), "--out", str(folder / "run"), *SETS]) == 0
    return folder


def test_a_trained_run_acts_by_weights_that_have_seen_all_rows(folder: Path) -> None:
    store, run = EpisodeStore.open(folder / "store"), folder / "run"
    whole, split = TrainedPolicy.load(run), TrainedPolicy.load(run, split=True)
    assert whole.record.train_steps == store.n_steps > split.record.train_steps
    assert whole.record.finished.steps == split.record.finished.steps
    assert (whole.rule, whole.record.rule) == (split.rule, split.record.rule)
    assert whole.fingerprint != split.fingerprint
    assert whole.folder == split.folder == run
    assert not torch.equal(whole.policy.head.correction, split.policy.head.correction)  # type: ignore[arg-type]
    assert torch.equal(whole.policy.state_mean, split.policy.state_mean)
    assert not torch.equal(whole.reward_model.item, split.reward_model.item)
    assert int(whole.counts.shown.sum()) == store.n_steps
    assert "policy        trained on all rows, up to step" in whole.record.describe()
    assert main(["verify", str(run)]) == 0


def test_the_test_split_is_ranked_by_the_weights_before(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = folder / "run"
    with pytest.raises(InputError, match="trained on the test split too"):
        held_out_sessions([TrainedPolicy.load(run)])
    assert held_out_sessions([TrainedPolicy.load(run, split=True)]).store.n_steps > 0
    assert main(["rank", str(run)]) == 0
    assert main(["ope", str(run)]) == 0
    assert "seen in training" not in capsys.readouterr().out
    assert main(["rank", str(run), str(folder / "log.parquet")]) == 0
    assert "100% of the rows were seen in training" in capsys.readouterr().out
    # All weights of a refit are those of its end.
    assert main(["rank", str(run), str(folder / "log.parquet"), "--checkpoint", "last"]) == 2
    assert "of which there is one checkpoint; leave it out" in capsys.readouterr().err
    assert main(["rank", str(run), "--checkpoint", "last"]) == 0


def test_a_refit_is_made_once_and_again_for_other_weights(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder / "run", run)
    store, file = EpisodeStore.open(folder / "store"), run / REFIT / "policy/best.safetensors"
    made = file.stat().st_mtime_ns
    refit_within(store, run)
    assert file.stat().st_mtime_ns == made
    more = ["--set", "train.steps=80"]
    assert main(["train", str(store.path), "--out", str(run), *SETS, *more]) == 0
    assert file.stat().st_mtime_ns > made
    assert main(["train", str(store.path), "--out", str(run), *SETS, *more, "--no-refit"]) == 0
    assert TrainedPolicy.load(run).record.refit_of is None


def test_an_interrupted_refit_is_not_used_and_goes_on(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder / "run", run)
    store, whole = EpisodeStore.open(folder / "store"), TrainedPolicy.load(run)
    # Killed before the rule is copied:
    RunRecord.read(run / REFIT).copy_with(rule=None).write(run / REFIT)
    assert TrainedPolicy.load(run).record.refit_of is None
    refit_within(store, run)
    assert TrainedPolicy.load(run).fingerprint == whole.fingerprint


def test_a_refit_moves_with_its_store(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "moved")
    log = pd.read_parquet(folder / "log.parquet")
    log["timestamp"] += 10**9
    log.to_parquet(tmp_path / "later.parquet")
    shutil.move(folder / "store", folder / "gone")
    try:
        code = main(["rank", str(tmp_path / "moved" / "run"), str(tmp_path / "later.parquet")])
    finally:
        shutil.move(folder / "gone", folder / "store")
    assert code == 0


def test_what_is_chosen_on_held_out_rows_is_kept(folder: Path, tmp_path: Path) -> None:
    run = str(tmp_path / "knn")
    assert main(["train", str(folder / "store"), "--out", run, "--policy", "item-knn"]) == 0
    whole, split = (TrainedPolicy.load(Path(run), split=each).policy for each in (False, True))
    assert torch.equal(whole.temperature, split.temperature)  # type: ignore[arg-type]
    assert not np.array_equal(whole.cosines, split.cosines)  # type: ignore[arg-type]
