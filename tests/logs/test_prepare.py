"""From log files to episodes: nothing lost unseen, nothing leaked, nothing half-written."""

import errno
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import SafetensorError

from tests.support.equal_times import tie_key
from tests.support.logs import write
from ucfrec import progress, schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.writer import StoreWriter
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.histories import read_histories
from ucfrec.logs.mapping import FeatureTable, LogMapping, log_files, read_columns, read_mapping
from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, validate
from ucfrec.logs.summary import format_report
from ucfrec_datasets import generic

START = 1_700_000_000_000
MINUTE = 60_000
SMALL = PrepareOptions(embedding_size=4)


def make_log(rows: int = 600, users: int = 25, items: int = 12, seed: int = 0) -> pd.DataFrame:
    """Random rows with repeated keys, in no order."""
    generator = np.random.default_rng(seed)
    log = pd.DataFrame(
        {
            "user_id": generator.integers(users, size=rows),
            "item_id": generator.integers(items, size=rows),
            # Coarse times, so that users have ties, repeated keys and long pauses.
            "timestamp": START + generator.integers(400, size=rows) * 10 * MINUTE,
            "reward": generator.integers(4, size=rows) / 2,
            "propensity": generator.uniform(0.01, 1, rows),
        }
    )
    return pd.concat([log, log.sample(rows // 10, random_state=seed)], ignore_index=True)


def steps_of(out: Path) -> pd.DataFrame:
    """All steps of a store, with ids and episode columns."""
    store = EpisodeStore.open(out)
    episodes, steps = store.all_steps()
    columns = {"episode": episodes, "step": steps}
    columns |= {n: store.episode_values(n)[episodes] for n in schema.EPISODE_DTYPES}
    columns |= {
        name: store.step_values(name, episodes, steps)
        for name in store.record.columns
        if name not in (schema.ACTION, schema.OBSERVATION)
    }
    frame = pd.DataFrame(columns)
    frame["user_id"] = pq.read_table(out / "users.parquet")["user_id"].to_numpy()[frame["user"]]
    if "item" in frame:
        ids = pq.read_table(out / "items.parquet")["item_id"].to_numpy()
        frame["item_id"] = ids[frame["item"]]
    return frame


def expected_sessions(log: pd.DataFrame, gap_minutes: float) -> pd.DataFrame:
    """An independent sessioniser: kept rows in order, with a session number."""
    kept = log.sort_values(["user_id", "timestamp", "item_id", "reward"], kind="stable")
    kept = kept.drop_duplicates(["user_id", "timestamp", "item_id"], keep="last")
    keys = zip(kept["user_id"], kept["timestamp"], kept["item_id"], strict=True)
    ties = np.array([tie_key(*key) for key in keys], dtype=np.uint64)
    kept = kept.iloc[np.lexsort((ties, kept["timestamp"], kept["user_id"]))].copy()
    silence = kept.groupby("user_id")["timestamp"].diff()
    kept["session"] = (silence.isna() | (silence > gap_minutes * MINUTE)).cumsum()
    return kept.reset_index(drop=True)


@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 10_000), gap=st.integers(5, 200), users=st.integers(1, 30))
def test_episodes_equal_those_of_an_independent_sessioniser(
    tmp_path_factory: pytest.TempPathFactory, seed: int, gap: int, users: int
) -> None:
    folder = tmp_path_factory.mktemp("logs")
    log = make_log(150, users=users, seed=seed)
    path = write(log, folder / "log.parquet")
    report = prepare(
        [path], LogMapping(), folder / "store", PrepareOptions(gap_minutes=gap, embedding_size=4)
    )
    expected = expected_sessions(log, gap)
    found = steps_of(folder / "store")
    assert report["dropped"]["duplicate"] == len(log) - len(expected)
    assert report["sessions"] == expected["session"].nunique()
    for name in ("user_id", "item_id", "timestamp"):
        np.testing.assert_array_equal(found[name], expected[name])
    np.testing.assert_array_equal(found["reward"], expected["reward"].astype("f4"))
    # Cut at the two boundaries, and terminated only where the session ends for certain: not if the
    # log ended within the gap after it.
    begin, end = report["split_times_ms"]
    split = (expected["timestamp"] >= begin).astype(int) + (expected["timestamp"] >= end)
    np.testing.assert_array_equal(found["split"], split)
    pieces = expected.assign(split=split).groupby(["session", "split"], sort=True).ngroup()
    np.testing.assert_array_equal(found["episode"], pieces)
    last_split = split.groupby(expected["session"]).transform("max")
    ends = expected.groupby("session")["timestamp"].transform("max")
    certain = expected["timestamp"].max() - ends > gap * 60_000
    np.testing.assert_array_equal(found["terminated"] == 1, (split == last_split) & certain)
    cut = expected.assign(split=split).groupby("session")["split"].nunique()
    assert report["sessions_cut"] == (cut > 1).sum()


def test_splits_are_windows_of_time(tmp_path: Path) -> None:
    path = write(make_log(), tmp_path / "log.parquet")
    report = prepare([path], LogMapping(), tmp_path / "store", SMALL)
    times = steps_of(tmp_path / "store").groupby("split")["timestamp"].agg(["min", "max", "size"])
    assert times["max"][0] < times["min"][1]
    assert times["max"][1] < times["min"][2]
    steps = steps_of(tmp_path / "store")
    for name in ("user", "item"):
        counts = pq.read_table(tmp_path / "store" / f"{name}s.parquet")["train_count"].to_numpy()
        trained = steps.loc[steps["split"] == 0, name]
        np.testing.assert_array_equal(counts, np.bincount(trained, minlength=len(counts)))
    assert times["size"].sum() == report["steps"]
    assert abs(times["size"][0] / report["steps"] - 0.8) < 0.02
    at = (START + 100 * MINUTE, START + 1000 * MINUTE)
    report = validate([path], LogMapping(), PrepareOptions(split=at))
    assert report["split_times_ms"] == list(at)
    assert parse_split("2023-11-14,2023-11-15T12:00") == (1699920000000, 1700049600000)
    assert parse_split("0.7,0.2,0.1") == (0.7, 0.2, 0.1)


def test_order_of_rows_and_files_is_immaterial(tmp_path: Path) -> None:
    log = make_log()
    log["is_random"] = log["item_id"] % 2
    log["observation"] = list(np.random.default_rng(0).normal(size=(len(log), 3)))
    once = prepare([write(log, tmp_path / "a.parquet")], LogMapping(), tmp_path / "once", SMALL)
    mixed = log.sample(frac=1, random_state=1)
    for number, part in enumerate(np.array_split(np.arange(len(log)), 3)):
        write(mixed.iloc[part], tmp_path / f"part{number}.parquet")
    again = prepare(
        [tmp_path / "part2.parquet", str(tmp_path / "part*.parquet")],
        LogMapping(),
        tmp_path / "again",
        SMALL,
    )
    stores = [EpisodeStore.open(tmp_path / name) for name in ("once", "again")]
    assert stores[0].record.fingerprint == stores[1].record.fingerprint
    assert stores[0].item_states.embeddings.equal(stores[1].item_states.embeddings)
    assert again["rows_read"] == len(log)
    assert again["unsorted_rows"] > 0
    for name in ("dropped", "steps", "sessions", "splits", "split_times_ms"):
        assert once[name] == again[name]


def test_csv_and_parquet_give_the_same_store(tmp_path: Path) -> None:
    log = make_log()
    log["when"] = pd.to_datetime(log.pop("timestamp"), unit="ms")
    log["uid"] = "u" + log.pop("user_id").astype(str)
    mapping = LogMapping(read_columns(["user_id=uid", "timestamp=when"]), reward="reward * 2")
    for kind in ("csv", "parquet"):
        prepare([write(log, tmp_path / f"log.{kind}")], mapping, tmp_path / kind, SMALL)
    stores = [EpisodeStore.open(tmp_path / kind).record for kind in ("csv", "parquet")]
    assert stores[0].fingerprint == stores[1].fingerprint
    assert stores[0].reward == "reward * 2"
    assert stores[0].source.mapping == {"user_id": "uid", "timestamp": "when"}
    assert steps_of(tmp_path / "csv")["user_id"].str.startswith("u").all()


@pytest.mark.parametrize(
    ("unit", "zone"),
    [("ms", None), ("us", None), ("ns", "UTC"), ("ms", "America/New_York"), ("ns", None)],
)
def test_times_of_every_unit_and_zone_are_read(
    unit: str, zone: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = make_log(users=5)
    log["timestamp"] = log["timestamp"] // 1000 * 1000
    prepare([write(log, tmp_path / "log.parquet")], LogMapping(), tmp_path / "wanted", SMALL)
    table = pa.Table.from_pandas(log)
    column = table.schema.get_field_index("timestamp")
    times = pa.array(log["timestamp"], pa.timestamp("ms")).cast(pa.timestamp(unit))
    named = pa.field("timestamp", pa.timestamp(unit, zone))
    pq.write_table(table.set_column(column, named, times.cast(named.type)), tmp_path / "t.parquet")
    features = {"item_id": range(30), "published": pa.array(range(30)).cast(named.type)}
    pq.write_table(pa.table(features), tmp_path / "items.parquet")
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        items = FeatureTable((tmp_path / "items.parquet",), "item_id")
        with_features = LogMapping(item_features=(items,))
        prepare([tmp_path / "t.parquet"], LogMapping(), tmp_path / "found", SMALL)
        prepare([tmp_path / "t.parquet"], with_features, tmp_path / "featured", SMALL)
    finally:
        monkeypatch.undo()
        time.tzset()
    found, wanted = (EpisodeStore.open(tmp_path / name).record for name in ("found", "wanted"))
    assert found.fingerprint == wanted.fingerprint
    embeddings = [
        EpisodeStore.open(tmp_path / name).item_states.embeddings for name in ("found", "featured")
    ]
    assert not torch.equal(*embeddings)


def test_every_dropped_row_has_a_reason(tmp_path: Path) -> None:
    log = make_log(users=5).astype({"user_id": "Int64", "timestamp": "Int64"})
    log = log.drop_duplicates(["user_id", "item_id", "timestamp"]).reset_index(drop=True)
    log.loc[:3, "user_id"] = None
    log.loc[4:5, "timestamp"] = 12
    log.loc[6, "timestamp"] = int(time.time() * 1000) + 3 * 86_400_000
    log.loc[7, "reward"] = np.nan
    log.loc[8, "reward"] = np.inf
    log.loc[9, "reward"] = None
    log.loc[10, "propensity"] = np.nan
    path = write(log, tmp_path / "log.parquet")
    report = validate([path], LogMapping(), PrepareOptions(min_steps=2))
    dropped = dict(report["dropped"])
    assert dropped.pop("short_episode") > 0
    assert dropped == {
        "left_out": 0,
        "long_session": 0,
        "null_key": 4,
        "clock_out_of_range": 3,
        "vector_not_finite": 0,
        "unknown_item": 0,
        "duplicate": 0,
        "reward_not_finite": 3,
    }
    assert report["unknown_propensities"] == 1
    assert report["rows_read"] == len(log) == report["steps"] + sum(report["dropped"].values())
    assert "clock_out_of_range" in format_report(report)
    assert list(tmp_path.iterdir()) == [path]


def test_repeated_rows_that_agree_are_no_conflict(tmp_path: Path) -> None:
    log = make_log().drop_duplicates(["user_id", "item_id", "timestamp"])
    log["reward"] = log["reward"].where(log.index > 0)  # an undefined reward equals itself
    again = log.iloc[:20].copy()
    again.iloc[5:8, again.columns.get_loc("reward")] += 1
    path = write(pd.concat([log, again]), tmp_path / "log.parquet")
    report = validate([path], LogMapping())
    assert report["dropped"]["duplicate"] == 20
    assert report["conflicting_duplicates"] == 3


def test_a_long_preparation_prints_lines_where_there_is_no_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "FIRST_LINE", 0)
    monkeypatch.setattr(progress, "NEXT_LINE", 0)
    path = write(make_log(), tmp_path / "log.parquet")
    prepare([path], LogMapping(), tmp_path / "store", SMALL)
    printed = capsys.readouterr().err.splitlines()
    assert any(line.startswith("check the logs:  25% 1/4") for line in printed)
    assert any(line.startswith("write the store: 100%") for line in printed)


@pytest.mark.parametrize("rows", [2, 30])
def test_a_log_of_one_row_a_user_is_prepared(tmp_path: Path, rows: int) -> None:
    log = pd.DataFrame({"user_id": range(rows), "item_id": 1, "timestamp": START})
    log["timestamp"] += np.arange(rows) * MINUTE
    log["reward"] = np.arange(rows) % 2
    options = PrepareOptions(split=(1.0, 0.0, 0.0))
    report = prepare([write(log, tmp_path / "l.parquet")], LogMapping(), tmp_path / "s", options)
    assert (report["unsorted_rows"], report["episodes"]) == (0, rows)


def test_undefined_parts_make_a_reward_undefined(tmp_path: Path) -> None:
    log = make_log().drop_duplicates(["user_id", "item_id", "timestamp"])
    log["play"], log["length"] = 3.0, np.arange(len(log)) % 3
    path = write(log, tmp_path / "log.parquet")

    def dropped(reward: str) -> int:
        report = validate([path], LogMapping(), PrepareOptions(reward=reward))
        return int(report["dropped"]["reward_not_finite"])

    unknown = int((log["length"] == 0).sum())
    assert dropped("least(play / length, 5)") == unknown
    assert dropped("greatest(play // length, 1, 2)") == unknown
    assert dropped("least(coalesce(nullif(length, 0), 2), 5)") == 0


def test_given_sessions_stay_together_even_where_they_overlap(tmp_path: Path) -> None:
    log = make_log(users=4).drop_duplicates(["user_id", "item_id", "timestamp"])
    log["session_id"] = np.random.default_rng(1).integers(6, size=len(log))
    options = PrepareOptions(split=(1.0, 0.0, 0.0), embedding_size=2)
    report = prepare([write(log, tmp_path / "l.parquet")], LogMapping(), tmp_path / "s", options)
    found = steps_of(tmp_path / "s")
    assert report["session_by"] == "session_id"
    keys = ["user_id", "item_id", "timestamp"]
    joined = found.merge(log[[*keys, "session_id"]], on=keys)
    assert len(joined) == len(log)
    assert (joined.groupby("episode")["session_id"].nunique() == 1).all()
    assert joined["episode"].nunique() == log.groupby(["user_id", "session_id"]).ngroups
    assert (found.groupby("episode")["timestamp"].diff().dropna() >= 0).all()
    off = validate([tmp_path / "l.parquet"], LogMapping({"session_id": ""}))
    assert off["session_by"] == "gap"
    by_user = validate([tmp_path / "l.parquet"], LogMapping(), PrepareOptions(session_by="user"))
    assert by_user["sessions"] == 4


def test_vector_actions(tmp_path: Path) -> None:
    log = make_log().drop(columns="item_id")
    log = log.drop_duplicates(["user_id", "timestamp"]).reset_index(drop=True)
    generator = np.random.default_rng(0)
    actions = generator.normal(size=(len(log), 3)).astype("f4")
    log["action"], log["observation"] = list(actions), list(actions[:, :2] * 2)
    log.loc[3, "action"][1] = np.nan
    repeated = pd.concat([log, log.iloc[10:20]])
    path = write(repeated, tmp_path / "log.parquet")
    report = prepare([path], LogMapping(), tmp_path / "store")
    assert report["dropped"]["vector_not_finite"] == 1
    assert report["dropped"]["duplicate"] == 10
    store = EpisodeStore.open(tmp_path / "store")
    assert (store.has_items, store.observation_size, store.state_size) == (False, 2, 2)
    episodes, steps = store.all_steps()
    found = store.step_values(schema.ACTION, episodes, steps)
    order = log.drop(index=3).sort_values(["user_id", "timestamp"]).index
    np.testing.assert_array_equal(found, actions[order])
    observed = store.step_values(schema.OBSERVATION, episodes, steps)
    np.testing.assert_array_equal(observed, actions[order][:, :2] * 2)


def test_a_store_like_another_has_its_numbers(tmp_path: Path) -> None:
    log = make_log()
    prepare([write(log, tmp_path / "a.parquet")], LogMapping(), tmp_path / "a", SMALL)
    later = make_log(seed=5, users=40, items=15)
    later["timestamp"] += 10**9
    write(later, tmp_path / "b.parquet")
    report = prepare(
        [tmp_path / "b.parquet"], LogMapping(), tmp_path / "b", SMALL, like=tmp_path / "a"
    )
    with pytest.raises(InputError, match="neither an episode store nor a run"):
        prepare([tmp_path / "b.parquet"], LogMapping(), tmp_path / "c", SMALL, like=tmp_path)
    assert report["dropped"]["unknown_item"] == (later["item_id"] >= 12).sum()
    store = EpisodeStore.open(tmp_path / "b")
    assert store.record.splits["train"]["steps"] == report["steps"] == store.n_steps
    assert set(store.episode_values("user")) == {-1, *range(25)}
    like = EpisodeStore.open(tmp_path / "a").item_states
    assert store.item_states.embeddings.equal(like.embeddings)


def test_histories_are_the_latest_clean_rows(tmp_path: Path) -> None:
    log = make_log()
    path = write(log, tmp_path / "log.parquet")
    batches = list(read_histories([path], LogMapping(), "reward * 1", last=5))
    found = pa.Table.from_batches(batches).to_pandas().set_index("user_id")
    expected = expected_sessions(log, 30)
    assert list(found.index) == sorted(log["user_id"].unique())
    for user, rows in expected.groupby("user_id"):
        assert list(found["item_ids"][user]) == list(rows["item_id"])[-5:]
        assert list(found["timestamps"][user]) == list(rows["timestamp"])[-5:]
        np.testing.assert_array_equal(found["rewards"][user], rows["reward"].astype("f4")[-5:])
        assert list(found["seen"][user]) == sorted(set(rows["item_id"]))


def test_memory_is_bounded(tmp_path: Path) -> None:
    rows = 1_000_000
    generator = np.random.default_rng(0)
    table = pa.table(
        {
            "user_id": generator.integers(50_000, size=rows),
            "item_id": generator.integers(500, size=rows),
            "timestamp": START + generator.integers(10**9, size=rows),
            "reward": generator.integers(2, size=rows).astype("f8"),
        }
    )
    pq.write_table(table, tmp_path / "log.parquet")
    report = validate(
        [tmp_path / "log.parquet"], LogMapping(), PrepareOptions(memory_limit="150MB")
    )
    assert report["steps"] + report["dropped"]["duplicate"] == rows


Change = Callable[[pd.DataFrame], Any]
CORRECT = PrepareOptions()
FAULTS: dict[str, tuple[Change, PrepareOptions, str]] = {
    "missing column": (
        lambda log: log.insert(0, "itemid", log.pop("item_id")),
        CORRECT,
        r"log.parquet has no column 'item_id'.*nearest: itemid",
    ),
    "missing reward": (
        lambda log: None,
        PrepareOptions(reward="least(rewrd, 1)"),
        r"no column 'rewrd'.*nearest: reward",
    ),
    "text time": (
        lambda log: log.__setitem__("timestamp", "noon"),
        CORRECT,
        r"timestamp \(timestamp\) is 'noon', no ISO 8601 time",
    ),
    "real ids": (
        lambda log: log.__setitem__("user_id", log["user_id"] + 0.5),
        CORRECT,
        r"user_id \(user_id\) is DOUBLE.*BIGINT",
    ),
    "text reward": (
        lambda log: log.__setitem__("reward", "much"),
        CORRECT,
        r"reward \(reward\) is VARCHAR",
    ),
    "seconds": (
        lambda log: log.__setitem__("timestamp", log["timestamp"] // 1000),
        CORRECT,
        r"no row is left \(660 rows: time before 2000.*milliseconds",
    ),
    "percentages": (
        lambda log: log.__setitem__("propensity", 60.0),
        CORRECT,
        r"propensity is above 1, up to 60, in \d+ of \d+ rows.*propensity / 100",
    ),
    "logarithms of propensities": (
        lambda log: log.__setitem__("propensity", np.log(log["propensity"] / 2)),
        CORRECT,
        r"propensity is not above 0, down to -\d.*, in \d+ of \d+ rows.*exp\(propensity\)",
    ),
    "unknown propensities as -1": (
        lambda log: log.__setitem__("propensity", log["propensity"].where(log.index > 9, -1.0)),
        CORRECT,
        r"is not above 0, down to -1, in \d+ of \d+ rows.*nullif\(propensity, -1\)",
    ),
    "a propensity of 0": (
        lambda log: log.__setitem__("propensity", log["propensity"].where(log.index != 9, 0.0)),
        CORRECT,
        r"is not above 0, down to 0, in 1 of \d+ rows.*nullif\(propensity, 0\)",
    ),
    "equal rewards": (
        lambda log: log.__setitem__("reward", 1.0),
        CORRECT,
        r"all \d+ rewards equal 1.*another reward",
    ),
    "no finite reward": (
        lambda log: log.__setitem__("reward", np.nan),
        CORRECT,
        r"no row is left .*NaN",
    ),
    "no session": (
        lambda log: None,
        PrepareOptions(min_steps=1000),
        r"no session is left: none of the \d+ clean rows",
    ),
    "no training": (lambda log: None, PrepareOptions(split=(5.0, 6.0)), r"training split"),
    "aggregate": (lambda log: None, PrepareOptions(reward="sum(reward)"), r"not a scalar SQL"),
    "window": (lambda log: None, PrepareOptions(reward="lag(reward) OVER ()"), r"not a scalar SQL"),
    "subquery": (lambda log: None, PrepareOptions(reward="(SELECT 1)"), r"not a scalar SQL"),
    "broken SQL": (lambda log: None, PrepareOptions(reward="reward +"), r"not a scalar SQL"),
    "unequal lists": (
        lambda log: log.__setitem__("observation", [[1.0] * (1 + (i == 7)) for i in log.index]),
        CORRECT,
        r"observation has lists of unequal length: 659 rows of 1, 1 rows of 2",
    ),
    "no sessions given": (
        lambda log: None,
        PrepareOptions(session_by="session_id"),
        r"no column 'session_id'",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_bad_logs_are_one_clear_error(tmp_path: Path, name: str) -> None:
    change, options, message = FAULTS[name]
    log = make_log()
    change(log)
    path = write(log, tmp_path / "log.parquet")
    for act in (
        lambda: prepare([path], LogMapping(), tmp_path / "store", options),
        lambda: validate([path], LogMapping(), options),
    ):
        with pytest.raises(InputError, match=message) as caught:
            act()
        assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]


def damaged(folder: Path, name: str) -> Path:
    path = write(make_log(), folder / "log.parquet")
    content = path.read_bytes()
    if name == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif name == "damaged":
        path.write_bytes(content[:40] + b"\xff" * 2000 + content[2040:])
    elif name == "no bytes":
        path.write_bytes(b"")
    elif name == "no rows":
        write(make_log().iloc[:0], path)
    elif name == "header only":
        path.unlink()
        path = write(make_log().iloc[:0], folder / "log.csv")
    elif name == "bad line":
        path.unlink()
        path = write(pd.concat([make_log()] * 60), folder / "log.csv")
        path.write_text(path.read_text() + "1,2,soon,1.0,0.5\n")
    return path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("truncated", r"log.parquet cannot be read.*truncated"),
        ("damaged", r"log.parquet cannot be read"),
        ("no bytes", r"log.parquet is empty \(0 bytes\)"),
        ("no rows", r"log.parquet is empty \(0 rows\)"),
        ("header only", r"log.csv is empty \(0 rows\)"),
        ("bad line", r"log.csv, line 39602: column timestamp: .*soon"),
    ],
)
def test_bad_files_are_one_clear_error(tmp_path: Path, name: str, message: str) -> None:
    path = damaged(tmp_path, name)
    with pytest.raises(InputError, match=message) as caught:
        prepare([path], LogMapping(), tmp_path / "store")
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere.parquet does not exist"):
        log_files([tmp_path / "nowhere.parquet"])
    with pytest.raises(InputError, match=r"\*.parquet matches no"):
        log_files([tmp_path / "*.parquet"])
    (tmp_path / "log.txt").touch()
    with pytest.raises(InputError, match=r"log.txt is not a .parquet or"):
        log_files([tmp_path / "log.txt"])
    with pytest.raises(InputError, match=r"'item' is not a log column"):
        LogMapping({"item": "x"})


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        (OSError, (errno.ENOSPC, "No space left on device")),
        (OSError, ("30952 requested and 13296 written",)),  # numpy's
        (SafetensorError, ("I/O error: No space left on device (os error 28)",)),
    ],
)
def test_a_full_disk_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type[Exception], told: tuple[Any, ...]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise kind(*told)

    path = write(make_log(), tmp_path / "log.parquet")
    monkeypatch.setattr(StoreWriter, "append", full)
    with pytest.raises(InputError, match=f"no space left on the disk of {tmp_path}"):
        prepare([path], LogMapping(), tmp_path / "store")
    assert list(tmp_path.iterdir()) == [path]


def test_an_output_that_exists_is_left_alone(tmp_path: Path) -> None:
    path = write(make_log(), tmp_path / "log.parquet")
    (tmp_path / "store").mkdir()
    with pytest.raises(InputError, match="exists already"):
        prepare([path], LogMapping(), tmp_path / "store")


def test_an_optional_column_of_some_files_is_left_out_with_a_note(tmp_path: Path) -> None:
    log = make_log().drop(columns="propensity")
    paths = [write(log.iloc[n::3], tmp_path / f"{n}.parquet") for n in range(3)]
    write(log.iloc[1::3].assign(SESSION_ID=1, is_random=1), paths[1])
    with pytest.warns(InputNote) as told:
        report = validate(paths, LogMapping())
    assert report["session_by"] == "gap"
    notes = [str(note.message) for note in told if note.category is InputNote]
    assert [note.partition(" is ")[0] for note in notes] == ["session_id", "is_random"]
    assert f"only 1 of 3 files have it ({paths[1]})" in notes[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)
        validate(paths, LogMapping({"session_id": "", "is_random": ""}))
        validate([paths[1]], LogMapping())


def test_generic_takes_features_from_files_called_items_and_users(tmp_path: Path) -> None:
    write(make_log(), tmp_path / "log.parquet")
    write(pd.DataFrame({"item_id": range(20), "price": range(20)}), tmp_path / "items.csv")
    files, mapping = generic.DATASET.resolve([tmp_path], LogMapping({"user_id": "u"}))
    assert files == (tmp_path / "log.parquet",)
    assert mapping.item_features == (FeatureTable((tmp_path / "items.csv",), "item_id"),)
    assert mapping.columns == {"user_id": "u"}


def test_a_mapping_is_read_from_toml(tmp_path: Path) -> None:
    (tmp_path / "mapping.toml").write_text(
        """
        reward = "is_click"
        [columns]
        user_id = "uid"
        [[item_features]]
        files = ["items.csv"]
        key = "iid"
        columns = ["price"]
        """
    )
    assert read_mapping(tmp_path / "mapping.toml") == LogMapping(
        {"user_id": "uid"},
        reward="is_click",
        item_features=(FeatureTable((tmp_path / "items.csv",), "iid", ("price",)),),
    )
    (tmp_path / "bad.toml").write_text("[columns]\nitem = 'x'\n")
    with pytest.raises(InputError, match=r"bad.toml: 'item' is not a log column"):
        read_mapping(tmp_path / "bad.toml")
    (tmp_path / "bad.toml").write_text("rewards = 'x'\n")
    with pytest.raises(InputError, match=r"bad.toml: .*rewards"):
        read_mapping(tmp_path / "bad.toml")


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ("[[items_features]]\nkey = 'x'", "there is no key 'items_features'; did you mean 'item_"),
        ("zzz = 1", "there is no key 'zzz'; there are columns, reward, session_by, item_feat"),
        ("remembered = 1", "there is no key 'remembered'; there are"),
        (
            "[[item_features]]\nfile = ['x']\nkey = 'x'",
            r"\[\[item_features\]\]: there is no key 'file'; did you mean 'files'\?",
        ),
        ("[[user_features]]\nfiles = ['x']", "it has no key 'key'; add it"),
        ("[item_features]\nfiles = ['x']", r"\[\[item_features\]\]: write it in double brackets"),
    ],
)
def test_a_key_that_a_mapping_does_not_have_is_named(tmp_path: Path, lines: str, told: str) -> None:
    (tmp_path / "bad.toml").write_text(f"{lines}\n")
    with pytest.raises(InputError, match=rf"bad\.toml.*{told}"):
        read_mapping(tmp_path / "bad.toml")


@pytest.mark.parametrize("given", ["gpa", "Gap", "", "visit", 3, ["gap"]])
def test_sessions_of_a_mapping_are_formed_in_a_known_way(tmp_path: Path, given: Any) -> None:
    """An unknown one had made one session of each user."""
    (tmp_path / "mapping.toml").write_text(f"session_by = {json.dumps(given)}\n")
    for make in (
        lambda: LogMapping(session_by=given),
        lambda: read_mapping(tmp_path / "mapping.toml"),
    ):
        with pytest.raises(InputError, match=r"session_by is .*; use session_id, gap, user"):
            make()


def test_sessions_by_a_column_that_no_file_has_are_refused(tmp_path: Path) -> None:
    path = write(make_log(), tmp_path / "log.parquet")
    with pytest.raises(InputError, match=r"no column 'session_id'"):
        validate([path], LogMapping(session_by="session_id"))
    path = write(make_log().assign(session_id=0.5), tmp_path / "log.parquet")
    with pytest.raises(
        InputError, match=r"session_id \(session_id\) is DOUBLE; use integers or text"
    ):
        validate([path], LogMapping(session_by="session_id"))


@pytest.mark.parametrize(
    "given",
    [
        {"gap_minutes": np.inf},
        {"gap_minutes": np.nan},
        {"gap_minutes": -1.0},
        {"min_steps": np.nan},
        {"embedding_size": np.nan},
        {"split": (0.0, np.inf)},
        {"split": (-np.inf, 0.0)},
        {"split": (np.nan, np.nan)},
    ],
)
def test_numbers_that_are_none_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=rf"{next(iter(given))} is .*must be"):
        PrepareOptions(**given)


def test_a_huge_gap_never_ends_a_session(tmp_path: Path) -> None:
    path = write(make_log(users=4), tmp_path / "log.parquet")
    assert validate([path], LogMapping(), PrepareOptions(gap_minutes=1e300))["sessions"] == 4


@pytest.mark.parametrize("folder", ["logs [1]", "a*b?", "it's {x,y}", "~", "$HOME"])
def test_globs_of_a_mapping_are_relative_to_a_folder_of_any_name(
    tmp_path: Path, folder: str
) -> None:
    here = tmp_path / folder
    here.mkdir()
    write(make_log(), here / "log [1].parquet")
    write(pd.DataFrame({"item_id": range(12), "price": range(12)}), here / "videos [1].csv")
    for files in ("videos*.csv", "videos [1].csv"):
        lines = f'[[item_features]]\nfiles = ["{files}"]\nkey = "item_id"\n'
        (here / "mapping.toml").write_text(lines)
        mapping = read_mapping(here / "mapping.toml")
        assert validate([here / "log [1].parquet"], mapping)["rows_read"] == 660


def test_a_path_that_no_pattern_matches_is_refused(tmp_path: Path) -> None:
    path = write(make_log(), tmp_path / "a\\[b].parquet")
    with pytest.raises(InputError, match=r"backslash and .*; rename it"):
        validate([path], LogMapping())


def test_ids_of_any_size_stay_apart(tmp_path: Path) -> None:
    for first, kind in ((2**64 - 12, "uint64"), (-(2**63), "int64"), (2**53, "int64")):
        ids = [first + n for n in range(12)]
        log = make_log()
        log["item_id"] = np.array(ids, dtype=kind)[log["item_id"]]
        features = pd.DataFrame({"item_id": np.array(ids, dtype=kind), "price": range(12)})
        table = FeatureTable((write(features, tmp_path / "items.csv"),), "item_id")
        out = tmp_path / str(first)
        for name in ("log.parquet", "log.csv"):
            path = write(log, tmp_path / name)
            prepare([path], LogMapping(item_features=(table,)), out / name[4:], SMALL)
            found = pq.read_table(out / name[4:] / "items.parquet")["item_id"].to_pylist()
            assert sorted(map(int, found)) == ids


def test_reals_are_no_ids_and_the_remedy_tells_of_rounding(tmp_path: Path) -> None:
    log = make_log()
    log["item_id"] = log["item_id"] + 2.0**53
    path = write(log, tmp_path / "log.parquet")
    with pytest.raises(InputError, match=r"is DOUBLE; .*at most 15 digits: others would be round"):
        validate([path], LogMapping())


@pytest.mark.parametrize("name", ["files", "columns"])
def test_one_name_in_place_of_a_list_is_refused(tmp_path: Path, name: str) -> None:
    """Its letters had been taken for names."""
    table = {"files": '["items.csv"]', "columns": '["price"]', name: '"price"'}
    lines = "\n".join(f"{field} = {value}" for field, value in table.items())
    (tmp_path / "m.toml").write_text(f'[[item_features]]\nkey = "item_id"\n{lines}\n')
    with pytest.raises(InputError, match=rf"m.toml: {name} of features is price; write a list"):
        read_mapping(tmp_path / "m.toml")


@pytest.mark.parametrize(
    ("rule", "kept"), [("highest", 5.0), ("lowest", 1.0), ("first", 3.0), ("last", 1.0)]
)
def test_the_rule_for_duplicates_is_chosen_and_recorded(
    tmp_path: Path, rule: str, kept: float
) -> None:
    log = pd.DataFrame(
        {
            "user_id": [1, 1, 1, 1, 2],
            "item_id": [1, 1, 1, 2, 2],
            "timestamp": START + np.array([0, 0, 0, 1, 2]),
            "reward": [3.0, 5.0, 1.0, 0.0, 0.5],
        }
    )
    options = PrepareOptions(duplicates=rule, embedding_size=2)
    report = prepare([write(log, tmp_path / "log.parquet")], LogMapping(), tmp_path / "s", options)
    assert steps_of(tmp_path / "s")["reward"].tolist() == [kept, 0.0, 0.5]
    assert (report["duplicates"], report["conflicting_duplicates"]) == (rule, 2)
    assert {"highest": "highest", "lowest": "lowest"}.get(rule, "in the files") in format_report(
        report
    )
    with pytest.raises(InputError, match="must be 'highest', 'lowest', 'first' or 'last'"):
        PrepareOptions(duplicates="any")


def test_rewards_near_the_end_of_float32_are_refused_with_their_number(tmp_path: Path) -> None:
    log = make_log()
    log.loc[[3, 5], "reward"] = [2e38, -1e13]
    path = write(log, tmp_path / "log.parquet")
    with pytest.raises(
        InputError, match=r"[12] of \d+ rewards are beyond ±1e\+12 \(up to 2e\+38\)"
    ):
        prepare([path], LogMapping(), tmp_path / "store", SMALL)
    divided = LogMapping(reward="reward / 1e30")
    prepare([path], divided, tmp_path / "store", SMALL)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_observation_that_is_not_finite_is_refused_with_row_counts(
    tmp_path: Path, value: float
) -> None:
    log = make_log()
    log["observation"] = list(np.random.default_rng(0).normal(size=(len(log), 3)))
    log.loc[7, "observation"][1] = value
    log.at[9, "observation"] = None
    path = write(log, tmp_path / "log.parquet")
    with pytest.raises(InputError, match=rf"observation is missing .* in 2 of {len(log)} rows"):
        prepare([path], LogMapping(), tmp_path / "store", SMALL)
    prepare([path], LogMapping({"observation": ""}), tmp_path / "store", SMALL)


def test_messages_do_not_repeat_line_breaks_of_foreign_text(tmp_path: Path) -> None:
    log = make_log().rename(columns={"reward": "click\n\x1b[31mforged: all is well"})
    path = write(log, tmp_path / "log.parquet")
    with pytest.raises(InputError) as caught:
        prepare([path], LogMapping(), tmp_path / "store", SMALL)
    assert str(caught.value).isprintable()


@pytest.mark.slow
def test_memory_stays_within_the_limit(tmp_path: Path) -> None:
    """A log that is larger than the limit, prepared by a process of its own."""
    rows, limit = 6_000_000, 800_000_000
    users = pa.array([f"user {n:050d}" for n in range(60_000)])
    items = pa.array([f"item {n:050d}" for n in range(5_000)])
    writer, size = None, 0
    for part in range(12):
        generator = np.random.default_rng(part)
        n = rows // 12
        table = pa.table(
            {
                "user_id": users.take(pa.array(generator.integers(len(users), size=n))),
                "item_id": items.take(pa.array(generator.integers(len(items), size=n))),
                "timestamp": START + generator.integers(10**10, size=n),
                "reward": generator.random(n),
            }
        )
        size += table.nbytes
        writer = writer or pq.ParquetWriter(tmp_path / "log.parquet", table.schema)
        writer.write_table(table)
    assert writer is not None
    writer.close()
    assert size > limit
    command = [sys.executable, "-m", "ucfrec", "prepare", tmp_path / "log.parquet"]
    command += ["--out", tmp_path / "store", "--memory-limit", "800MB"]
    # A child's peak begins with the memory of the process that starts it, which is large here.
    measured = (
        "import resource, subprocess, sys\n"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)\n"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    end = subprocess.run(
        [sys.executable, "-c", measured, *map(str, command)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert int(end.stdout) * 1024 < limit
    assert EpisodeStore.open(tmp_path / "store").record.n_steps == rows
