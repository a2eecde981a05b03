"""Rows at equal times have no order that could be learned, and the same one everywhere."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from tests.support.equal_times import tie_key
from ucfrec import schema
from ucfrec.commands.cli import main
from ucfrec.errors import InputNote
from ucfrec.files.atomic import read_json
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.kept import DUPLICATES, kept_in_order
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import validate

DAY = 86_400_000
START = 1_700_006_400_000


def days(users: int, days: int, a_day: int, items: int = 200) -> pd.DataFrame:
    """Independent items, all of a day at its midnight."""
    generator = np.random.default_rng(0)
    rows = [
        (user, item, START + day * DAY)
        for user in range(users)
        for day in range(days)
        for item in generator.choice(items, a_day, replace=False)
    ]
    log = pd.DataFrame(rows, columns=["user_id", "item_id", "timestamp"])
    log["reward"] = (generator.random(len(log)) < 0.3) * 1.0
    return log


def items_of(batches: list[pa.RecordBatch]) -> dict[str, list[str]]:
    histories = pa.Table.from_batches(batches).to_pylist()
    return {str(each["user_id"]): list(map(str, each["item_ids"])) for each in histories}


@pytest.mark.parametrize("text", [(), ("user_id",), ("item_id",), ("user_id", "item_id")])
def test_files_frames_and_requests_have_one_order_whatever_the_order_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: tuple[str, ...]
) -> None:
    monkeypatch.setattr("ucfrec.logs.engine.BATCH_ROWS", 100)
    log = days(users=15, days=6, a_day=12)
    expected = {
        str(user): [
            str(item)
            for _, _, item in sorted(
                (time, tie_key(user, time, item), item)
                for time, item in zip(each.timestamp, each.item_id, strict=True)
            )
        ]
        for user, each in log.groupby("user_id")
    }
    given = log.astype(dict.fromkeys(text, str)).sample(frac=1, random_state=1)
    given.to_parquet(tmp_path / "log.parquet")
    options = LogMapping(), "reward", 1000
    assert items_of(list(read_histories([tmp_path / "log.parquet"], *options))) == expected
    assert items_of(list(frame_histories(given, *options))) == expected
    for user, each in given.groupby("user_id"):
        items = each["item_id"].to_numpy(dtype=object if "item_id" in text else np.int64)
        columns = {
            "user": np.zeros(len(each), dtype=np.int64),
            schema.TIMESTAMP: each["timestamp"].to_numpy(),
            schema.ITEM: items,
            schema.REWARD: each["reward"].to_numpy(),
            "row": np.arange(len(each)),
        }
        assert isinstance(user, (int, str))
        order = kept_in_order(columns, "highest", user)
        assert [*map(str, items[order])] == expected[str(user)]


def test_the_order_says_nothing_of_the_item_nor_of_other_users() -> None:
    log = days(users=40, days=3, a_day=12, items=20)
    columns = {"user": log["user_id"], "timestamp": log["timestamp"], "item": log["item_id"]}
    rows = {name: values.to_numpy() for name, values in columns.items()}
    rows |= {"reward": np.zeros(len(log)), "row": np.arange(len(log))}
    ordered = log.iloc[kept_in_order(rows, "highest")]
    place = ordered.groupby(["user_id", "timestamp"]).cumcount()
    # Means of 36 or more independent places of 12: 3.45 / 6 each.
    for name in ("item_id", "timestamp"):
        assert (place.groupby(ordered[name]).mean() - 5.5).abs().max() < 4 * 3.45 / 6
    assert abs(np.corrcoef(place, ordered["item_id"])[0, 1]) < 0.1


@pytest.mark.parametrize("duplicates", DUPLICATES)
def test_duplicates_among_equal_times_count_once(duplicates: str) -> None:
    rows = {
        "user": np.zeros(4, dtype=np.int64),
        "timestamp": np.full(4, START),
        "item": np.array(["b", "a", "b", "c"], dtype=object),
        "reward": np.array([1.0, 0, 2, 0]),
        "row": np.arange(4),
    }
    kept = kept_in_order(rows, duplicates, "user")
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


@pytest.mark.slow
def test_a_policy_learns_nothing_of_the_order_of_equal_times(tmp_path: Path) -> None:
    """Of 200 random items, ten hold the next one in 5% of the cases; by item id it is in 33%."""
    days(users=80, days=10, a_day=12).to_parquet(tmp_path / "log.parquet")
    store, run, rows = (str(tmp_path / name) for name in ("store", "run", "rows.json"))
    bounds = ",".join(f"{pd.Timestamp(START + n * DAY, unit='ms'):%Y-%m-%d}" for n in (8, 9))
    log = str(tmp_path / "log.parquet")
    assert main(["prepare", log, "--out", store, "--session-by", "user", "--split", bounds]) == 0
    small = ["--set", "train.steps=600", "--set", "policy.dim=32"]
    assert main(["train", store, "--policy", "sasrec", "--out", run, *small]) == 0
    rule = ["--temperature", "0", "--reward-weight", "0"]
    assert main(["rank", run, *rule, "--json", rows]) == 0
    (row,) = [each for each in read_json(Path(rows)) if each["policy"] == "sasrec"]
    assert row["metrics"]["hit_rate_shown"] < 0.08
