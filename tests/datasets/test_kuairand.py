"""KuaiRand: official file names of all releases, and the real rows."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.real_data import data_folder
from ucfrec import schema
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare, validate
from ucfrec_datasets.kuairand import DATASET

FEEDBACK = "is_click is_like is_follow is_comment is_forward is_hate long_view"
NUMBERS = "is_lowactive_period is_live_streamer is_video_author register_days "
NUMBERS += "follow_user_num fans_user_num friend_user_num"


def official(folder: Path, suffix: str, parts: dict[str, int]) -> None:
    """Small CSV files in the official schema, cut into as many parts as the release has."""
    folder.mkdir(exist_ok=True)
    generator = np.random.default_rng(0)
    rows, videos, users = 300, 30, 20
    log = {
        "user_id": generator.integers(users, size=rows),
        "video_id": generator.integers(videos, size=rows),
        "time_ms": 1_649_500_000_000 + generator.integers(10**9, size=rows),
        **{name: generator.integers(2, size=rows) for name in FEEDBACK.split()},
        "play_time_ms": generator.integers(9000, size=rows),
        "duration_ms": generator.integers(1, 9000, size=rows),
        **{"date": 20220410, "hourmin": 1200, "profile_stay_time": 0, "is_rand": 0, "tab": 1},
    }
    ids = np.arange(videos)
    basic = {
        **{"video_id": ids, "author_id": ids, "video_type": "NORMAL", "upload_dt": "2022-04-10"},
        "upload_type": np.where(ids % 2, "Web", "LongImport"),
        **{"video_duration": 1000.0 * ids, "visible_status": 0.0, "server_width": 720.0},
        **{"server_height": 1280.0, "music_id": ids, "music_type": 9.0},
        "tag": [f"{i % 3},{i % 5}" if i % 7 else None for i in ids],
    }
    people = {"user_id": np.arange(users), "user_active_degree": "full_active"}
    names = NUMBERS.split() + [f"onehot_feat{i}" for i in range(18)]
    people |= {name: generator.integers(5, size=users) for name in names}
    tables = {
        f"log_random_4_22_to_5_08_{suffix}": {**log, "time_ms": log["time_ms"] + 1, "is_rand": 1},
        f"log_standard_4_08_to_4_21_{suffix}": log,
        f"log_standard_4_22_to_5_08_{suffix}": {**log, "time_ms": log["time_ms"] + 10**9},
        f"user_features_{suffix}": people,
        f"video_features_basic_{suffix}": basic,
    }
    for name, columns in tables.items():
        frame = pd.DataFrame(columns)
        count = next((n for start, n in parts.items() if name.startswith(start)), 1)
        for number, piece in enumerate(np.array_split(np.arange(len(frame)), count), 1):
            ending = f"_part{number}" if count > 1 else ""
            frame.iloc[piece].to_csv(folder / f"{name}{ending}.csv", index=False)


PARTS = {"pure": {}, "1k": {}, "27k": {"log_standard": 2, "video_features_basic": 3}}


@pytest.mark.parametrize("suffix", PARTS)
def test_official_files_of_every_release(tmp_path: Path, suffix: str) -> None:
    source, parts = tmp_path / "data", PARTS[suffix]
    official(source, suffix, parts)
    files, mapping = DATASET.resolve([source], LogMapping())
    assert len(files) == (5 if parts else 3)
    (basic,) = mapping.item_features
    assert len(basic.files) == (3 if parts else 1)
    report = prepare(files, mapping, tmp_path / "store", PrepareOptions(embedding_size=8))
    assert report["rows_read"] == 900
    assert report["reward"] == "is_click"
    store = EpisodeStore.open(tmp_path / "store")
    randomly = store.step_values(schema.IS_RANDOM, *store.all_steps())
    assert 250 < randomly.sum() <= 300
    assert store.item_states.embeddings.shape == (30, 8)
    assert (store.item_states.embeddings.norm(dim=1) > 0).all()
    assert store.item_states.user_features.shape[1] >= 20


def test_files_may_be_named_one_by_one(tmp_path: Path) -> None:
    official(tmp_path, "pure", {})
    name = "log_standard_4_08_to_4_21_pure.csv"
    files, mapping = DATASET.resolve([tmp_path / name], LogMapping(reward="long_view"))
    assert files == (tmp_path / name,)
    assert mapping.reward == "long_view"
    assert len(mapping.item_features) == len(mapping.user_features) == 1
    with pytest.raises(InputError, match=r"no KuaiRand log among 1 file"):
        DATASET.resolve([tmp_path / "user_features_pure.csv"], LogMapping())
    # The statistics, which tell of the future, are joined only when they are named.
    statistics = tmp_path / "video_features_statistic_pure.csv"
    pd.DataFrame({"video_id": [1]}).to_csv(statistics, index=False)
    for paths, tables in (([tmp_path], 1), ([tmp_path, statistics], 2)):
        assert len(DATASET.resolve(paths, LogMapping())[1].item_features) == tables


@pytest.mark.realdata
def test_what_is_dropped_is_what_an_independent_count_finds() -> None:
    folder = data_folder("kuairand")
    log = pd.read_parquet(next(folder.glob("log_*.parquet")))
    files, mapping = DATASET.resolve([folder], LogMapping())
    kept = log.drop_duplicates(["user_id", "video_id", "time_ms"])
    report = validate(files, mapping)
    dropped = {**dict.fromkeys(report["dropped"], 0), "duplicate": len(log) - len(kept)}
    assert report["dropped"] == dropped
    assert report["dropped"]["duplicate"] == 2979
    assert report["rows_read"] == len(log) == 94_784
    assert report["users"] == log["user_id"].nunique()
    assert report["items"] == log["video_id"].nunique()
    # Videos of unknown length earn no watch ratio.
    reward = "least(play_time_ms / duration_ms, 5)"
    report = validate(files, mapping, PrepareOptions(reward=reward))
    known = kept[kept["duration_ms"] > 0]
    assert report["dropped"]["reward_not_finite"] == len(kept) - len(known)
    ratio = np.minimum(known["play_time_ms"] / known["duration_ms"], 5)
    assert report["reward_statistics"]["mean"] == pytest.approx(ratio.mean(), rel=1e-3)


def test_a_run_knows_its_log_is_of_kuairand_whatever_the_next_is_called(tmp_path: Path) -> None:
    official(folder := tmp_path / "data", "pure", {})
    (later := tmp_path / "later").mkdir()
    store, run, out = (str(tmp_path / name) for name in ("store", "run", "scores.parquet"))
    assert main(["prepare", str(folder), "--dataset", "kuairand", "--out", store]) == 0
    assert main(["train", store, "--policy", "popular", "--out", run]) == 0
    name = "log_standard_4_08_to_4_21_pure.csv"
    for called in (name, "may.csv"):
        shutil.copy(folder / name, later / called)
    # The same rows under plain names, as an own service would log them.
    plain = {"video_id": "item_id", "time_ms": "timestamp", "is_click": "reward"}
    own = pd.read_csv(folder / name).rename(columns=plain)[["user_id", *plain.values()]]
    own.to_parquet(later / "own.parquet")
    scores = []
    for called in (name, "may.csv", "own.parquet"):
        assert main(["score", run, str(later / called), "--out", out]) == 0
        scores.append(pd.read_parquet(out))
        assert len(scores[-1]) > 200
        pd.testing.assert_frame_equal(scores[-1], scores[0])
