"""Rows that are sorted and checked in batches are those that pandas keeps."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ucfrec.logs.engine import engine
from ucfrec.logs.kept import DUPLICATES
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.sorted_rows import sort_rows
from ucfrec.logs.tables import open_tables
from ucfrec.logs.typed import typed_log

START = 1_700_000_000_000


def make_log(seed: int, text: bool) -> pd.DataFrame:
    """Few keys, many duplicates that differ in some column, and every fault."""
    generator = np.random.default_rng(seed)
    n = 400
    log = pd.DataFrame(
        {
            "user_id": generator.integers(-2, 6, n),
            "item_id": generator.integers(5, size=n),
            "timestamp": START + generator.integers(8, size=n),
            "reward": generator.choice([0, 1, 2, np.nan, np.inf, -np.inf], n),
            "propensity": generator.choice([0.25, 0.5, np.nan], n),
            "is_random": generator.integers(2, size=n),
            "session_id": generator.integers(3, size=n),
        }
    )
    log["user_id"], log["item_id"] = log["user_id"].astype("Int64"), log["item_id"].astype("Int64")
    if text:
        log["user_id"] = "u" + log["user_id"].astype("string")
        log["item_id"] = "i" + log["item_id"].astype("string")
        log["session_id"] = "s" + log["session_id"].astype("string")
    log.loc[generator.integers(n, size=4), "user_id"] = None
    log.loc[generator.integers(n, size=4), "item_id"] = None
    log.loc[generator.integers(n, size=4), "timestamp"] = 5
    return log


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


@pytest.mark.parametrize("duplicates", DUPLICATES)
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("in_memory", [False, True])
def test_the_rows_that_are_kept_are_those_of_pandas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, duplicates: str, text: bool, in_memory: bool
) -> None:
    monkeypatch.setattr("ucfrec.logs.engine.BATCH_ROWS", 64)
    path = tmp_path / "log.parquet"
    given = make_log(len(duplicates), text)
    given.to_parquet(path)
    expected, dropped, conflicts = kept_by_pandas(given, duplicates)
    folder = None if in_memory else tmp_path
    with engine([path], tmp_path) as connection:
        tables = tuple(open_tables(connection, [path]))
        log = typed_log(connection, tables, LogMapping(), "reward", "gap", tmp_path)
        rows = sort_rows(log, None, duplicates, folder)
        batches = list(rows.file.read())
    assert len(batches) > 1
    found = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
    # Equal times have an order of their own: `tests/logs/test_kept.py`.
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
    pq.write_table(pa.table(columns), file, row_group_size=max(rows // 4, 1))
    return numbers


def test_long_rows_are_sorted_in_less_memory_than_they_take(tmp_path: Path) -> None:
    file = tmp_path / "log.parquet"
    numbers = write_log(file, 20_000, 1024)
    assert numbers.nbytes > 80e6
    with engine([file], tmp_path, "40MB", threads=1) as connection:
        tables = tuple(open_tables(connection, [file]))
        log = typed_log(connection, tables, LogMapping(), "reward", "user", tmp_path)
        rows = sort_rows(log, None, "highest", tmp_path)
        order = np.concatenate([batch["row"] for batch in rows.file.read()])
        assert rows.observations is not None
        found = rows.observations.of_rows(order[9_000:9_100])
    by_user = np.lexsort((np.arange(20_000), np.arange(20_000) % 7))
    np.testing.assert_array_equal(order, by_user + 1)
    np.testing.assert_array_equal(found, numbers[by_user[9_000:9_100]])
