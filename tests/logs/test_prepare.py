"""From log files to episodes: nothing lost unseen, nothing leaked, nothing half-written."""

import errno
import subprocess
import sys
import time
import warnings
from decimal import Decimal
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import SafetensorError

from tests.support.equal_times import tie_key
from tests.support.logs import START, write
from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.writer import StoreWriter
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.mapping import FeatureTable, LogMapping, read_columns, read_mapping
from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, validate

MINUTE = 60_000
KEYS = ["user_id", "item_id", "timestamp"]
SMALL = PrepareOptions(embedding_size=4)
ALL_TRAIN = PrepareOptions(split=(1.0, 0.0, 0.0), embedding_size=2)


def make_log(rows: int = 600, users: int = 25, items: int = 12, seed: int = 0) -> pd.DataFrame:
    """Random rows with repeated keys, in no order."""
    generator = np.random.default_rng(seed)
    columns = {
        "user_id": generator.integers(users, size=rows),
        "item_id": generator.integers(items, size=rows),
        # Coarse times, so that users have ties, repeated keys and long pauses.
        "timestamp": START + generator.integers(400, size=rows) * 10 * MINUTE,
        "reward": generator.integers(4, size=rows) / 2,
        "propensity": generator.uniform(0.01, 1, rows),
    }
    log = pd.DataFrame(columns)
    return pd.concat([log, log.sample(rows // 10, random_state=seed)], ignore_index=True)


def prepared(folder: Path, log: pd.DataFrame, options: PrepareOptions = SMALL) -> dict[str, Any]:
    """The report on a log; its store is at `folder / "store"`."""
    return prepare([write(log, folder / "log.parquet")], LogMapping(), folder / "store", options)


def steps_of(out: Path) -> pd.DataFrame:
    """All steps of a store, with ids and episode columns."""
    store = EpisodeStore.open(out)
    episodes, steps = store.all_steps()
    columns = {"episode": episodes, "step": steps}
    columns |= {n: store.episode_values(n)[episodes] for n in schema.EPISODE_DTYPES}
    names = {*store.record.columns} - {schema.ACTION, schema.OBSERVATION}
    columns |= {name: store.step_values(name, episodes, steps) for name in names}
    return pd.DataFrame(columns).join(store.to_frame()[["user_id", "item_id"]])


def expected_sessions(log: pd.DataFrame, gap_minutes: float) -> pd.DataFrame:
    """An independent sessioniser: kept rows in order, with a session number."""
    kept = log.sort_values([*KEYS, "reward"], kind="stable").drop_duplicates(KEYS, keep="last")
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
    report = prepared(folder, log, PrepareOptions(gap_minutes=gap, embedding_size=4))
    expected = expected_sessions(log, gap)
    found = steps_of(folder / "store")
    assert report["dropped"]["duplicate"] == len(log) - len(expected)
    assert report["sessions"] == expected["session"].nunique()
    for name in KEYS:
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
    certain = expected["timestamp"].max() - ends > gap * MINUTE
    np.testing.assert_array_equal(found["terminated"] == 1, (split == last_split) & certain)
    cut = expected.assign(split=split).groupby("session")["split"].nunique()
    assert report["sessions_cut"] == (cut > 1).sum()


def test_splits_are_windows_of_time(tmp_path: Path) -> None:
    prepared(tmp_path, make_log())
    steps = steps_of(tmp_path / "store")
    assert abs((steps["split"] == 0).mean() - 0.8) < 0.02
    for name in ("user", "item"):
        counts = pq.read_table(tmp_path / "store" / f"{name}s.parquet")["train_count"].to_numpy()
        trained = steps.loc[steps["split"] == 0, name]
        np.testing.assert_array_equal(counts, np.bincount(trained, minlength=len(counts)))
    at = (START + 100 * MINUTE, START + 1000 * MINUTE)
    report = validate([tmp_path / "log.parquet"], LogMapping(), PrepareOptions(split=at))
    assert report["split_times_ms"] == list(at)
    assert parse_split("2023-11-14,2023-11-15T12:00") == (1699920000000, 1700049600000)


def test_order_of_rows_and_files_is_immaterial(tmp_path: Path) -> None:
    log = make_log()
    log["is_random"] = log["item_id"] % 2
    log["observation"] = list(np.random.default_rng(0).normal(size=(len(log), 3)))
    once = prepared(tmp_path, log)
    mixed = log.sample(frac=1, random_state=1)
    for number, part in enumerate(np.array_split(np.arange(len(log)), 3)):
        write(mixed.iloc[part], tmp_path / f"part{number}.parquet")
    paths = [tmp_path / "part2.parquet", str(tmp_path / "part*.parquet")]
    again = prepare(paths, LogMapping(), tmp_path / "again", SMALL)
    stores = [EpisodeStore.open(tmp_path / name) for name in ("store", "again")]
    assert stores[0].record.fingerprint == stores[1].record.fingerprint
    assert stores[0].item_states.embeddings.equal(stores[1].item_states.embeddings)
    assert again["rows_read"] == len(log)
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
    assert stores[0].source.mapping == {"user_id": "uid", "timestamp": "when"}
    assert stores[0].source.decisions == len(log[["uid", "when"]].drop_duplicates())
    assert steps_of(tmp_path / "csv")["user_id"].str.startswith("u").all()


def test_every_dropped_row_has_a_reason(tmp_path: Path) -> None:
    log = make_log(users=5).astype({"user_id": "Int64", "timestamp": "Int64"})
    log = log.drop_duplicates(KEYS).reset_index(drop=True)
    log.loc[:3, "user_id"] = None
    log.loc[4:5, "timestamp"] = 12
    log.loc[6, "timestamp"] = int(time.time() * 1000) + 3 * 86_400_000
    log.loc[[7, 8, 9], "reward"] = [np.nan, np.inf, np.nan]
    log.loc[10, "propensity"] = np.nan
    path = write(log, tmp_path / "log.parquet")
    report = validate([path], LogMapping(), PrepareOptions(min_steps=2))
    dropped = dict(report["dropped"])
    assert dropped.pop("short_episode") > 0
    wanted = {"null_key": 4, "clock_out_of_range": 3, "reward_not_finite": 3}
    assert dropped == {**dict.fromkeys(dropped, 0), **wanted}
    assert report["unknown_propensities"] == 1
    assert report["rows_read"] == len(log) == report["steps"] + sum(report["dropped"].values())
    assert list(tmp_path.iterdir()) == [path]


def test_given_sessions_stay_together_even_where_they_overlap(tmp_path: Path) -> None:
    log = make_log(users=4).drop_duplicates(KEYS)
    log["session_id"] = np.random.default_rng(1).integers(6, size=len(log))
    assert prepared(tmp_path, log, ALL_TRAIN)["session_by"] == "session_id"
    found = steps_of(tmp_path / "store")
    joined = found.merge(log[[*KEYS, "session_id"]], on=KEYS)
    assert len(joined) == len(log)
    assert (joined.groupby("episode")["session_id"].nunique() == 1).all()
    assert joined["episode"].nunique() == log.groupby(["user_id", "session_id"]).ngroups
    assert (found.groupby("episode")["timestamp"].diff().dropna() >= 0).all()
    path = tmp_path / "log.parquet"
    endless = validate([path], LogMapping({"session_id": ""}), PrepareOptions(gap_minutes=1e300))
    assert (endless["session_by"], endless["sessions"]) == ("gap", 4)
    assert validate([path], LogMapping(), PrepareOptions(session_by="user"))["sessions"] == 4


def test_vector_actions(tmp_path: Path) -> None:
    log = make_log().drop(columns="item_id")
    log = log.drop_duplicates(["user_id", "timestamp"]).reset_index(drop=True)
    actions = np.random.default_rng(0).normal(size=(len(log), 3)).astype("f4")
    log["action"], log["observation"] = list(actions), list(actions[:, :2] * 2)
    log.loc[3, "action"][1] = np.nan
    report = prepared(tmp_path, pd.concat([log, log.iloc[10:20]]))
    assert report["dropped"]["vector_not_finite"] == 1
    assert report["dropped"]["duplicate"] == 10
    store = EpisodeStore.open(tmp_path / "store")
    assert (store.has_items, store.observation_size, store.state_size) == (False, 2, 2)
    places = store.all_steps()
    order = log.drop(index=3).sort_values(["user_id", "timestamp"]).index
    np.testing.assert_array_equal(store.step_values(schema.ACTION, *places), actions[order])
    observed = store.step_values(schema.OBSERVATION, *places)
    np.testing.assert_array_equal(observed, actions[order][:, :2] * 2)


def test_a_store_like_another_has_its_numbers(tmp_path: Path) -> None:
    prepared(tmp_path, make_log())
    later = make_log(seed=5, users=40, items=15)
    later["timestamp"] += 10**9
    path, like = write(later, tmp_path / "later.parquet"), tmp_path / "store"
    report = prepare([path], LogMapping(), tmp_path / "later", SMALL, like=like)
    assert report["dropped"]["unknown_item"] == (later["item_id"] >= 12).sum()
    store = EpisodeStore.open(tmp_path / "later")
    assert report["steps"] == store.n_steps
    assert set(store.episode_values("user")) == {-1, *range(25)}
    embeddings = EpisodeStore.open(like).item_states.embeddings
    assert store.item_states.embeddings.equal(embeddings)


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError("30952 requested and 13296 written"),  # numpy's
        OSError(errno.EFBIG, "File too large"),
        SafetensorError("I/O error: No space left on device (os error 28)"),
    ],
)
def test_a_full_disk_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(StoreWriter, "append", Mock(side_effect=error))
    with pytest.raises(InputError, match=f"no space left on the disk of {tmp_path}"):
        prepared(tmp_path, make_log())
    assert [path.name for path in tmp_path.iterdir()] == ["log.parquet"]
    (tmp_path / "store").mkdir()
    with pytest.raises(InputError, match="exists already"):
        prepared(tmp_path, make_log())


def test_an_optional_column_of_some_files_is_left_out_with_a_note(tmp_path: Path) -> None:
    log = make_log().drop(columns="propensity")
    paths = [write(log.iloc[n::3], tmp_path / f"{n}.parquet") for n in range(3)]
    write(log.iloc[1::3].assign(SESSION_ID=range(220), is_random=1), paths[1])
    with pytest.warns(InputNote) as told:
        report = validate(paths, LogMapping())
    assert report["session_by"] == "gap"
    notes = [str(note.message) for note in told if note.category is InputNote]
    assert [note.partition(" is ")[0] for note in notes[:2]] == ["session_id", "is_random"]
    assert f"only 1 of 3 files have it ({paths[1]})" in notes[0]
    assert "users have 24.0 rows, but sessions 1.2, and policies do not see earlier" in notes[2]
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputNote)
        for files, columns in ((paths, {"session_id": "", "is_random": ""}), (paths[1:2], {})):
            validate(files, LogMapping(columns), PrepareOptions(session_by="user"))


@pytest.mark.parametrize("folder", ["logs [1]", "a*b?", "it's {x,y}", "~", "$HOME"])
def test_globs_of_a_mapping_are_relative_to_its_folder(tmp_path: Path, folder: str) -> None:
    here = tmp_path / folder
    log = write(make_log(), here / "log [1].parquet")
    write(pd.DataFrame({"item_id": range(12), "price": range(12)}), here / "videos [1].csv")
    for files in ("videos*.csv", "videos [1].csv"):
        lines = f'[[item_features]]\nfiles = ["{files}"]\nkey = "item_id"\n'
        (here / "mapping.toml").write_text(lines)
        assert validate([log], read_mapping(here / "mapping.toml"))["rows_read"] == 660


def test_ids_of_any_size_stay_apart(tmp_path: Path) -> None:
    kinds = {2**64 - 12: "uint64", 7: "uint64", -(2**63): "int64", Decimal(2**62): "object"}
    for first, kind in kinds.items():
        ids = np.array([first + n for n in range(12)], dtype=kind)
        log = make_log()
        log["item_id"] = ids[log["item_id"]]
        features = pd.DataFrame({"item_id": ids, "price": range(12)})
        table = FeatureTable((write(features, tmp_path / "items.csv"),), "item_id")
        for name in ("log.parquet", "log.csv"):
            path, out = write(log, tmp_path / name), tmp_path / f"{first}-{name}"
            prepare([path], LogMapping(item_features=(table,)), out, SMALL)
            found = pq.read_table(out / "items.parquet")["item_id"].to_pylist()
            assert sorted(map(int, found)) == ids.tolist()
            assert isinstance(found[0], str) == (first > 2**63)


def write_large_log(path: Path, rows: int, users: pa.Array, items: pa.Array) -> int:
    """Write random rows in twelve parts; returns the bytes that they take in memory."""
    size = 0
    for part in range(12):
        generator, n = np.random.default_rng(part), rows // 12
        columns = {
            "user_id": users.take(generator.integers(len(users), size=n)),
            "item_id": items.take(generator.integers(len(items), size=n)),
            "timestamp": START + generator.integers(10**10, size=n),
            "reward": generator.random(n),
        }
        pq.write_table(pa.table(columns), path / f"{part}.parquet")
        size += pa.table(columns).nbytes
    return size


def test_memory_is_bounded(tmp_path: Path) -> None:
    write_large_log(tmp_path, 960_000, pa.array(range(50_000)), pa.array(range(500)))
    report = validate([tmp_path], LogMapping(), PrepareOptions(memory_limit="150MB"))
    assert report["steps"] + report["dropped"]["duplicate"] == 960_000


@pytest.mark.slow
def test_memory_stays_within_the_limit(tmp_path: Path) -> None:
    """A log that is larger than the limit, prepared by a process of its own."""
    rows, limit = 6_000_000, 800_000_000
    users = pa.array([f"user {n:050d}" for n in range(60_000)])
    items = pa.array([f"item {n:050d}" for n in range(5_000)])
    (tmp_path / "logs").mkdir()
    assert write_large_log(tmp_path / "logs", rows, users, items) > limit
    command = [sys.executable, "-m", "ucfrec", "prepare", tmp_path / "logs"]
    command += ["--out", tmp_path / "store", "--memory-limit", "800MB"]
    # A child's peak begins with the memory of the process that starts it, which is large here.
    measured = (
        "import resource, subprocess, sys\n"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)\n"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    process = [sys.executable, "-c", measured, *map(str, command)]
    end = subprocess.run(process, check=True, stdout=subprocess.PIPE, text=True)
    assert int(end.stdout) * 1024 < limit
    assert EpisodeStore.open(tmp_path / "store").record.n_steps == rows
