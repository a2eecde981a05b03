"""The completed KuaiRand environment: what it finds in planted clicks, and in the real rows."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch

from tests.support.logs import store_of
from tests.support.real_data import data_folder
from ucfrec.acting.rollout import Uniform, rollout
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.plugins import load_plugin
from ucfrec_simulators.kuai.behaviors import Oracle
from ucfrec_simulators.kuai.completion import CompletionConfig, complete
from ucfrec_simulators.kuai.environment import REGIMES
from ucfrec_simulators.kuai.kuairand import kuairand, main, read_tags

USERS, ITEMS = 60, 30
QUICK = CompletionConfig(steps=300, dropout=0.2, learning_rate=1e-2)


def planted_store(folder: Path, seed: int = 0, clicks: str = "planted") -> EpisodeStore:
    """Two kinds of users, each of whom clicks one half of the items nine times of ten."""
    rng = np.random.default_rng(seed)
    log = pd.DataFrame({"user_id": rng.integers(USERS, size=6000) + 100})
    log["item_id"] = rng.integers(ITEMS, size=6000)
    log["timestamp"] = 1_650_000_000_000 + np.arange(6000) * 60_000
    liked = log["user_id"] % 2 == log["item_id"] % 2
    log["is_click"] = (rng.random(6000) < np.where(liked, 0.9, 0.1)).astype(int)
    if clicks == "ratings":
        log["is_click"] = rng.integers(6, size=6000)
    folder.mkdir()
    return store_of(log, folder, reward="is_click", session_by="user", embedding_size=4)


def test_planted_clicks_are_found_and_the_environment_pays_them(tmp_path: Path) -> None:
    store = planted_store(tmp_path / "log")
    tags = {item: (item % 7,) for item in range(ITEMS) if item % 5}
    report = complete(store, tags, tmp_path / "environment", QUICK)
    assert report.auc > 0.85
    assert report.log_loss < 0.45 < report.base_log_loss
    assert report.calibration_error < 0.06
    written = json.loads((tmp_path / "environment" / "completion.json").read_text())
    assert written["auc"] == report.auc
    env = kuairand(16, tmp_path / "environment")
    assert (env.tags[0], env.tags[6]) == ((-1,), (6,))
    users, items = np.indices((USERS, ITEMS))
    paid = env.rewards[users, items]
    liked = (env.user_ids[users] % 2) == (env.item_ids[items] % 2)
    assert paid[~liked].mean() < 0.2 < 0.8 < paid[liked].mean()
    best = rollout(env, Oracle(env, 0), 64, 0).returns.mean()
    assert best > 2 * rollout(env, Uniform(env, 0), 64, 0).returns.mean()


def test_equal_seeds_give_equal_files_and_nothing_is_left_of_a_failure(tmp_path: Path) -> None:
    store = planted_store(tmp_path / "log")
    for name in "ab":
        torch.manual_seed(ord(name))
        complete(store, {}, tmp_path / name, CompletionConfig(steps=60), seed=3)
    for file in ("users.parquet", "items.parquet"):
        one, other = (pq.read_table(tmp_path / name / file) for name in "ab")
        assert one.equals(other)
    ratings = planted_store(tmp_path / "other", clicks="ratings")
    with pytest.raises(InputError, match="rewards are not clicks"):
        complete(ratings, {}, tmp_path / "c", QUICK)
    assert not (tmp_path / "c").exists()
    with pytest.raises(InputError, match=r"users\.parquet is missing; make them with"):
        kuairand(1, tmp_path / "c")


@pytest.mark.slow
@pytest.mark.realdata
def test_real_rows_make_an_environment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Evaluated on 29–30 April; what policies learn from, the days before, stays out."""
    source = data_folder("kuairand")
    log = pd.read_parquet(next(source.glob("log_*.parquet")))
    folder = tmp_path / "later"
    folder.mkdir()
    log[log["date"] >= 20220429].to_parquet(folder / "log_standard_judge_pure.parquet")
    basic = folder / "video_features_basic_pure.csv"
    for file in ("user_features_pure.csv", basic.name):
        shutil.copy(source / file, folder / file)
    files, mapping = load_plugin("datasets", "kuairand").resolve([folder], LogMapping())
    prepare(files, mapping, tmp_path / "store", PrepareOptions(embedding_size=16))
    arguments = [str(tmp_path / "store"), str(basic), "--out", str(tmp_path / "environment")]
    assert main(arguments) == 0
    assert "27285 users × 7583 items" in capsys.readouterr().out
    report = json.loads((tmp_path / "environment" / "completion.json").read_text())
    assert report["auc"] > 0.62
    assert report["log_loss"] < report["base_log_loss"] - 0.03
    assert report["calibration_error"] < 0.06
    assert main(arguments) == 2
    tags = read_tags(basic)
    assert max(map(len, tags.values())) <= 3
    for regime in REGIMES.values():
        env = kuairand(16, tmp_path / "environment", regime=regime)
        best, dull = (rollout(env, kind(env, 0), 16, 0) for kind in (Oracle, Uniform))
        assert best.returns.mean() > 1.3 * dull.returns.mean()
        assert 0 < dull.returns.sum() / dull.lengths.sum() < 1
