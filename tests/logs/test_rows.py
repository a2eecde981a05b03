"""Rows that are sorted in batches are those that pandas keeps, and equal times have one order."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.equal_times import tie_key
from tests.support.logs import START, faulty_log, list_users
from ucfrec import schema
from ucfrec.errors import InputNote
from ucfrec.logs.engine import engine
from ucfrec.logs.histories import Histories, frame_histories, read_histories
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import validate
from ucfrec.logs.rows import choose_rows, sort_rows
from ucfrec.logs.typed import open_log, open_log_tables


def kept_by_pandas(log: pd.DataFrame, duplicates: str) -> tuple[pd.DataFrame, dict[str, int], int]:
    """The rows to keep, in order of user, time and item, the number of the others by reason, and
    how many duplicates have another reward; rewards that are not finite are equal."""
    missing = log[["user_id", "item_id", "timestamp"]].isna().any(axis=1)
    late = ~missing & (log["timestamp"] < START)
    left = log[~missing & ~late].reset_index(names="row")
    left["bad"] = ~np.isfinite(left["reward"])
    rule = {"highest": -left["reward"], "lowest": left["reward"], "first": left["row"]}
    left["rule"] = rule.get(duplicates, -left["row"])
    key = ["user_id", "timestamp", "item_id"]
    order = left.sort_values([*key, "bad", "rule", "propensity", "session_id", "is_random"])
    single = order.drop_duplicates(key)
    good = single[~single["bad"]]
    rewards = order["reward"].where(~order["bad"], np.inf)
    first = rewards.groupby([order[name] for name in key]).transform("first")
    dropped = {
        "null_key": int(missing.sum()),
        "clock_out_of_range": int(late.sum()),
        "duplicate": len(left) - len(single),
        "reward_not_finite": len(single) - len(good),
    }
    return good, dropped, int((rewards != first).sum())


@pytest.mark.parametrize("duplicates", ["highest", "lowest", "first", "last"])
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("in_memory", [False, True])
def test_the_rows_that_are_kept_are_those_of_pandas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, duplicates: str, text: bool, in_memory: bool
) -> None:
    monkeypatch.setattr("ucfrec.logs.typed.BATCH_ROWS", 64)
    path = tmp_path / "log.parquet"
    given = faulty_log(400, text, len(duplicates))
    given.to_parquet(path)
    expected, dropped, conflicts = kept_by_pandas(given, duplicates)
    folder = None if in_memory else tmp_path
    with engine([path], tmp_path) as connection:
        tables = open_log_tables(connection, [path], LogMapping(), "reward", "gap")
        log = open_log(tables)
        rows = sort_rows(log, None, duplicates, folder)
        batches = list(rows.file.read())
    assert len(batches) > 1
    found = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
    # Equal times have an order of their own: below.
    order = np.lexsort([found[name] for name in ("item_code", "timestamp", "user_code")])
    found = {name: values[order] for name, values in found.items()}
    assert {name: n for name, n in rows.dropped.items() if n} == dropped
    assert (rows.read, rows.count, rows.conflicts) == (400, len(expected), conflicts)
    assert 0 < rows.conflicts < dropped["duplicate"]
    for name in ("timestamp", "reward", "propensity", "is_random"):
        np.testing.assert_array_equal(found[name], expected[name].astype(found[name].dtype))
    for name in ("user", "item"):
        # Codes are in the order of the ids.
        ranks = expected[f"{name}_id"].astype("category").cat.codes
        assert [*np.unique(found[f"{name}_code"], return_inverse=True)[1]] == [*ranks]


def write_log(file: Path, rows: int, size: int) -> np.ndarray:
    """A log whose users take turns; returns the observations (rows, size)."""
    numbers = np.random.default_rng(0).normal(size=(rows, size)).astype(np.float32)
    lists = pa.FixedSizeListArray.from_arrays(pa.array(numbers.ravel()), size)
    columns = {
        "user_id": np.arange(rows) % 7,
        "item_id": np.arange(rows) % 3,
        "timestamp": START + np.arange(rows),
        "reward": np.ones(rows),
        "observation": lists.cast(pa.list_(pa.float32())),
    }
    pq.write_table(pa.table(columns), file, row_group_size=rows // 4)
    return numbers


def test_long_rows_are_sorted_in_less_memory_than_they_take(tmp_path: Path) -> None:
    file = tmp_path / "log.parquet"
    numbers = write_log(file, 20_000, 1024)
    assert numbers.nbytes > 80e6
    with engine([file], tmp_path, "80MB", threads=1) as connection:
        tables = open_log_tables(connection, [file], LogMapping(), "reward", "user")
        log = open_log(tables)
        rows = sort_rows(log, None, "highest", tmp_path)
        order = np.concatenate([batch["row"] for batch in rows.file.read()])
        found = rows.observations.read(order[9_000:9_100])
    by_user = np.lexsort((np.arange(20_000), np.arange(20_000) % 7))
    np.testing.assert_array_equal(order, by_user + 1)
    np.testing.assert_array_equal(found, numbers[by_user[9_000:9_100]])


DAY = 86_400_000
MIDNIGHT = 1_700_006_400_000


def days(users: int, days: int, a_day: int, items: int = 200) -> pd.DataFrame:
    """Independent items, all of a day at its midnight."""
    generator = np.random.default_rng(0)
    rows = [
        (user, item, MIDNIGHT + day * DAY)
        for user in range(users)
        for day in range(days)
        for item in generator.choice(items, a_day, replace=False)
    ]
    log = pd.DataFrame(rows, columns=["user_id", "item_id", "timestamp"])
    log["reward"] = (generator.random(len(log)) < 0.3) * 1.0
    return log


def items_of(batches: list[Histories]) -> dict[str, list[str]]:
    users = list_users(batches)
    return {str(each["user_id"]): list(map(str, each["item_ids"])) for each in users}


@pytest.mark.parametrize("text", [(), ("user_id",), ("item_id",)])
def test_files_frames_and_requests_have_one_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: tuple[str, ...]
) -> None:
    monkeypatch.setattr("ucfrec.logs.typed.BATCH_ROWS", 100)
    log = days(users=15, days=6, a_day=12)
    keys = zip(log["user_id"], log["timestamp"], log["item_id"], strict=True)
    ordered = log.assign(tie=[tie_key(*key) for key in keys]).sort_values(["timestamp", "tie"])
    expected = {
        str(user): [*map(str, items)] for user, items in ordered.groupby("user_id")["item_id"]
    }
    given = log.astype(dict.fromkeys(text, str)).sample(frac=1, random_state=1)
    given.to_parquet(tmp_path / "log.parquet")
    options = LogMapping(), "reward", 1000
    assert items_of(list(read_histories([tmp_path / "log.parquet"], *options))) == expected
    assert items_of(list(frame_histories(given, *options))) == expected
    for user, each in given.groupby("user_id"):
        items = each["item_id"].to_numpy(dtype=object if "item_id" in text else np.int64)
        columns = {
            "user": each["user_id"].to_numpy(),
            schema.TIMESTAMP: each["timestamp"].to_numpy(),
            schema.ITEM: items,
            schema.REWARD: each["reward"].to_numpy(),
            "row": np.arange(len(each)),
        }
        order = choose_rows(columns, "highest")
        assert [*map(str, items[order])] == expected[str(user)]


def test_the_order_says_nothing_of_the_item_nor_of_other_users() -> None:
    log = days(users=40, days=3, a_day=12, items=20)
    columns = {"user": log["user_id"], "timestamp": log["timestamp"], "item": log["item_id"]}
    rows = {name: values.to_numpy() for name, values in columns.items()}
    rows |= {"reward": np.zeros(len(log)), "row": np.arange(len(log))}
    ordered = log.iloc[choose_rows(rows, "highest")]
    place = ordered.groupby(["user_id", "timestamp"]).cumcount()
    # Means of 36 or more independent places of 12: 3.45 / 6 each.
    for name in ("item_id", "timestamp"):
        assert (place.groupby(ordered[name]).mean() - 5.5).abs().max() < 4 * 3.45 / 6
    assert abs(np.corrcoef(place, ordered["item_id"])[0, 1]) < 0.1


@pytest.mark.parametrize("duplicates", ["highest", "lowest", "first", "last"])
def test_duplicates_among_equal_times_count_once(duplicates: str) -> None:
    rows = {
        "user": np.full(4, "user", dtype=object),
        "timestamp": np.full(4, MIDNIGHT),
        "item": np.array(["b", "a", "b", "c"], dtype=object),
        "reward": np.array([1.0, 0, 2, 0]),
        "row": np.arange(4),
    }
    kept = choose_rows(rows, duplicates)
    wanted = {"highest": 2, "lowest": 0, "first": 0, "last": 2}[duplicates]
    assert sorted(kept) == sorted([1, wanted, 3])


@pytest.mark.parametrize(("apart", "warned"), [(0, True), (DAY // 24, False)])
def test_a_log_of_days_is_reported(tmp_path: Path, apart: int, warned: bool) -> None:
    log = days(users=20, days=5, a_day=4)
    log["timestamp"] += np.tile(np.arange(4), len(log) // 4) * apart
    log.to_parquet(tmp_path / "log.parquet")
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", InputNote)
        report = validate([tmp_path / "log.parquet"], LogMapping())
    assert report["equal_times"] == (len(log) if warned else 0)
    assert any("100% of the rows share their time" in str(note.message) for note in notes) == warned
