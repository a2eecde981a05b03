"""KuaiRec: files generated in the official schema, dirt included, as logs and as an environment."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.evaluate import evaluate_behavior
from ucfrec.evaluation.simulator import Environment
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec_datasets.kuairec import DATASET
from ucfrec_simulators.kuai.kuairec import SIMULATOR_NX_10, kuairec

USERS, VIDEOS, JUDGED_USERS, JUDGED_VIDEOS = 12, 40, 8, 25


def matrix(pairs: np.ndarray, rng: np.random.Generator) -> pd.DataFrame:
    """Rows of big_matrix or small_matrix for (user, video) pairs."""
    seconds = np.sort(1_594_000_000 + rng.uniform(0, 9e5, len(pairs))).round(3)
    moments = pd.to_datetime(seconds, unit="s")
    play, duration = rng.integers(0, 30_000, len(pairs)), rng.integers(2_000, 30_000, len(pairs))
    columns = {"user_id": pairs[:, 0], "video_id": pairs[:, 1], "play_duration": play}
    columns |= {"video_duration": duration, "time": moments.strftime("%Y-%m-%d %H:%M:%S.%f")}
    columns |= {"date": moments.strftime("%Y%m%d").astype(int), "timestamp": seconds}
    return pd.DataFrame(columns | {"watch_ratio": play / duration})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """All files, as their authors wrote them: NaN times, repeated rows, lists as text."""
    (folder := tmp_path / "data").mkdir()
    rng = np.random.default_rng(0)
    pairs = np.stack([rng.integers(USERS, size=900), rng.integers(VIDEOS, size=900)], axis=1)
    big = matrix(pairs, rng)
    pd.concat([big, big.iloc[100:130]]).to_csv(folder / "big_matrix.csv", index=False)
    every = np.array([(u, v) for u in range(JUDGED_USERS) for v in range(5, 5 + JUDGED_VIDEOS)])
    small = matrix(every[rng.permutation(len(every))[:-3]], rng)
    untimed = small.sample(20, random_state=0).index
    small.loc[untimed, ["time", "date", "timestamp"]] = np.nan
    small.to_csv(folder / "small_matrix.csv", index=False)
    tags = [sorted(rng.choice(31, size=rng.integers(1, 5), replace=False)) for _ in range(VIDEOS)]
    feat = [str([int(tag) for tag in own]) for own in tags]
    categories = pd.DataFrame({"video_id": range(VIDEOS), "feat": feat})
    categories.to_csv(folder / "item_categories.csv", index=False)
    people = {"user_id": range(USERS), "user_active_degree": "full_active"}
    for name in ("is_lowactive_period", "is_live_streamer", "is_video_author"):
        people[name] = rng.integers(2, size=USERS)
    for name in ("follow_user_num", "fans_user_num", "friend_user_num", "register_days"):
        people |= {name: rng.integers(500, size=USERS), f"{name}_range": "(0,500]"}
    people |= {f"onehot_feat{i}": rng.integers(3, size=USERS).astype(float) for i in range(18)}
    users = pd.DataFrame(people)
    users.loc[3, "onehot_feat4"] = np.nan
    users.to_csv(folder / "user_features.csv", index=False)
    video, day = np.tile(np.arange(VIDEOS), 3), np.repeat(range(3), VIDEOS)
    daily = {
        **{"video_id": video, "date": 20200705 + day, "author_id": video // 3},
        **{"video_type": "NORMAL", "upload_dt": [f"2020-03-{1 + n % 28:02d}" for n in video]},
        **{"upload_type": np.where(video % 2, "LongImport", "Web"), "visible_status": "public"},
        "video_duration": np.where(video % 5, 1000.0 * video, np.nan),
        **{"video_width": 720, "video_height": np.where(video % 3, 1280, 400), "music_id": video},
        **{"video_tag_id": video % 4, "video_tag_name": "tag", "show_cnt": day},
    }
    pd.DataFrame(daily).to_csv(folder / "item_daily_features.csv", index=False)
    return folder


def test_a_folder_means_the_training_matrix(folder: Path, tmp_path: Path) -> None:
    files, mapping = DATASET.resolve([folder], LogMapping())
    assert [file.name for file in files] == ["big_matrix.csv"]
    report = prepare(files, mapping, tmp_path / "store", PrepareOptions(embedding_size=8))
    assert report["rows_read"] == 930
    assert report["dropped"]["duplicate"] == 30
    store = EpisodeStore.open(tmp_path / "store")
    assert store.n_steps == 900
    assert store.step_values("reward", *store.all_steps()).max() <= 5
    assert store.item_states.embeddings.shape == (VIDEOS, 8)
    assert store.item_states.user_features.shape[0] == USERS


def test_rows_without_a_time_are_counted(folder: Path, tmp_path: Path) -> None:
    files, mapping = DATASET.resolve([folder / "small_matrix.csv"], LogMapping())
    report = prepare(files, mapping, tmp_path / "store", PrepareOptions(embedding_size=4))
    assert report["rows_read"] == JUDGED_USERS * JUDGED_VIDEOS - 3
    assert report["dropped"]["null_key"] == 20
    with pytest.raises(InputError, match="no log among 1 file"):
        DATASET.resolve([folder / "user_features.csv"], LogMapping())


def test_the_environment_is_the_observed_matrix(folder: Path) -> None:
    env = kuairec(1, folder)
    small = pd.read_csv(folder / "small_matrix.csv")
    wanted = small.pivot_table(index="user_id", columns="video_id", values="watch_ratio")
    paid = env.rewards[*np.indices(env.rewards.shape)]
    np.testing.assert_allclose(paid, wanted.clip(0, 5).fillna(0), rtol=1e-6)
    assert paid.max() == 5
    np.testing.assert_array_equal(env.item_ids, np.arange(5, 5 + JUDGED_VIDEOS))
    feat = pd.read_csv(folder / "item_categories.csv").set_index("video_id")["feat"]
    assert [str(list(own)) for own in env.tags] == feat.loc[env.item_ids].tolist()


def test_it_is_played_by_name(folder: Path) -> None:
    environment = Environment("kuairec", folder)
    earned = {b: evaluate_behavior(environment, b, 50, 0)["R_cum"] for b in ("random", "oracle")}
    assert earned["oracle"] > 2 * earned["random"]
    assert SIMULATOR_NX_10.make(3, environment.folder).regime.steps == 10


def test_missing_and_foreign_files_are_named(folder: Path) -> None:
    categories = pd.read_csv(folder / "item_categories.csv")
    categories.iloc[:10].to_csv(folder / "item_categories.csv", index=False)
    matrix = folder / "small_matrix.csv"
    for change, says in (
        (lambda: None, r"item_categories\.csv lacks 20 videos such as 10"),
        (lambda: matrix.write_text("a,b\n1,2\n"), r"small_matrix\.csv is not the official file"),
        (matrix.unlink, r"small_matrix\.csv is missing; get it from"),
    ):
        change()
        with pytest.raises(InputError, match=says):
            kuairec(1, folder)
