"""A run remembers how its training log was read, and reads later logs and frames in that way."""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ucfrec import Recommender
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.logs import LogMapping

MAPPING = """
reward = "least(stars, 5) >= 4"
time_format = "%d/%m/%Y %H:%M:%S"
where = "agent <> 'bot'"
[columns]
user_id = "uid"
item_id = "concat('i', sku)"
timestamp = "at"
propensity = "shown_with"
"""
TRAIN = ["--set", "train.steps=60", "--set", "train.validate_every=30", "--set", "policy.dim=8"]
TRAIN += ["--set", "policy.context=4", "--set", "rule.choose=false", "--set", "augment.copies=0"]


def shop(rows: int = 1500, start: str = "2024-02-03", seed: int = 0) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    frame = pd.DataFrame({"uid": rng.integers(50, size=rows), "sku": rng.integers(12, size=rows)})
    times = pd.Timestamp(start) + pd.to_timedelta(np.arange(rows) * 60, unit="s")
    frame["at"] = times.strftime("%d/%m/%Y %H:%M:%S")
    frame["stars"] = rng.integers(1, 7, size=rows)
    frame["shown_with"] = 1 / 12
    return frame.assign(agent=np.where(frame.uid == 7, "bot", "person"))


def plain(frame: pd.DataFrame) -> pd.DataFrame:
    """The same log with the names of the schema."""
    kept = frame[frame.agent != "bot"]
    times = pd.to_datetime(kept["at"], format="%d/%m/%Y %H:%M:%S")
    ids = {"user_id": kept.uid, "item_id": "i" + kept.sku.astype(str)}
    rewards = (kept.stars.clip(upper=5) >= 4).astype(float)
    frame = pd.DataFrame({**ids, "timestamp": times, "propensity": 1 / 12, "reward": rewards})
    return frame.reset_index(drop=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("remembered")
    (folder / "shop.toml").write_text(MAPPING)
    shop().to_parquet(folder / "log.parquet")
    late = shop(400, "2024-02-10", 1)
    late.to_parquet(folder / "late.parquet")
    late.to_csv(folder / "late.csv", index=False)
    plain(late).to_parquet(folder / "plain.parquet")
    paths = [str(folder / name) for name in ("log.parquet", "store", "run", "shop.toml")]
    assert main(["prepare", paths[0], "--mapping", paths[3], "--out", paths[1]]) == 0
    assert main(["train", paths[1], "--policy", "dt", "--out", paths[2], *TRAIN]) == 0
    return folder


def scored(folder: Path, log: str, *more: str) -> pd.DataFrame:
    out = folder / f"{log}-{len(more)}.parquet"
    assert main(["score", str(folder / "run"), str(folder / log), "--out", str(out), *more]) == 0
    return pd.read_parquet(out)


def test_the_record_keeps_all_of_the_mapping(folder: Path) -> None:
    for source in (
        read_json(folder / "store/meta.json")["source"],
        read_json(folder / "run/run.json")["data"],
    ):
        assert source["mapping"]["item_id"] == "concat('i', sku)"
        assert source["time_format"] == "%d/%m/%Y %H:%M:%S"
        assert source["where"] == "agent <> 'bot'"


@pytest.mark.parametrize("log", ["late.csv", "plain.parquet"])
def test_a_later_log_is_read_as_the_first_whatever_its_names(folder: Path, log: str) -> None:
    """ISO times, plain names and a plain reward stand for what the run remembers."""
    expected = scored(folder, "late.parquet", "--mapping", str(folder / "shop.toml"))
    assert 0 < len(expected) < 400
    pd.testing.assert_frame_equal(scored(folder, log), expected)


def test_no_command_needs_the_mapping_again(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, late, mapping = (str(folder / name) for name in ("run", "late.parquet", "shop.toml"))
    for command in ("rank", "ope"):
        told = []
        for more in ([], ["--mapping", mapping]):
            assert main([command, run, late, *more]) == 0
            told.append(capsys.readouterr().out)
        assert told[0] == told[1]
    frames = []
    for n, more in enumerate(([], ["--mapping", mapping])):
        out = folder / f"next-{n}.parquet"
        assert main(["recommend", run, late, "--k", "3", "--out", str(out), *more]) == 0
        frames.append(pd.read_parquet(out))
    pd.testing.assert_frame_equal(*frames)
    assert 7 not in set(frames[0].user_id)


def test_a_given_column_or_condition_wins(folder: Path) -> None:
    late = pd.read_parquet(folder / "late.parquet").assign(other=lambda frame: frame.uid + 1000)
    late.to_parquet(folder / "other.parquet")
    assert scored(folder, "other.parquet").user_id.max() < 1000
    found = scored(folder, "other.parquet", "--column", "user_id=other", "--where", "1 = 1")
    assert found.user_id.min() >= 1000
    assert 1007 in set(found.user_id)


def test_a_log_with_neither_column_is_refused_with_both_names(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = pd.read_parquet(folder / "late.parquet").rename(columns={"uid": "who"})
    late.to_parquet(folder / "who.parquet")
    run, out = str(folder / "run"), str(folder / "no.parquet")
    assert main(["score", run, str(folder / "who.parquet"), "--out", out]) != 0
    told = capsys.readouterr().err
    assert re.search("has neither 'uid'.* nor a column 'user_id'", told)
    with pytest.raises(InputError, match=r"neither 'uid'.*nor a column 'user_id'") as error:
        Recommender.load(folder / "run").recommend(late)
    assert str(error.value).startswith("histories ")
    assert "--" not in str(error.value)


def test_frames_are_read_as_the_training_log(folder: Path) -> None:
    policy, late = Recommender.load(folder / "run"), pd.read_parquet(folder / "late.parquet")
    found = policy.recommend(late, k=3)
    pd.testing.assert_frame_equal(found, policy.recommend(plain(late), k=3))
    columns = {"user_id": "cast(uid as varchar)"}
    as_text = policy.recommend(late, k=3, mapping=LogMapping(columns))
    assert set(as_text.user_id) == set(found.user_id.astype(str))


def frame_without(**changes: Any) -> pd.DataFrame:
    rng, n = np.random.default_rng(0), 300
    frame = pd.DataFrame({"user_id": rng.integers(9, size=n), "item_id": rng.integers(5, size=n)})
    frame = frame.assign(
        timestamp=1_700_000_000_000 + 1000 * np.arange(n), reward=1.0 * (rng.random(n) < 0.4)
    )
    return frame.rename(columns={k: v for k, v in changes.items() if isinstance(v, str)}).assign(
        **{k: v for k, v in changes.items() if not isinstance(v, str)}
    )


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        (frame_without(user_id="who"), "mapping=LogMapping({'user_id': ...})"),
        (frame_without(user_id=0.5), "'(user_id)::BIGINT'"),
        (frame_without(timestamp=True), "'seconds * 1000'"),
        (frame_without(reward=np.nan), "reward is missing"),
    ],
)
def test_errors_of_frames_name_the_frame_not_a_scratch_file_or_an_option(
    frame: pd.DataFrame, said: str
) -> None:
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        with pytest.raises(InputError) as error:
            Recommender("popular").fit(frame)
    for text in (str(error.value), *(str(each.message) for each in noted)):
        assert text.startswith("data"), text
        assert ".parquet" not in text
        assert "--" not in text
    assert said in str(error.value)
