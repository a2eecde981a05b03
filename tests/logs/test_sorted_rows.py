"""Rows that are sorted and checked in batches are those that the one SQL query keeps."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ucfrec.logs.binding import open_tables
from ucfrec.logs.clean import DUPLICATES, check_rows, drop_counts
from ucfrec.logs.engine import engine
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.sorted_rows import check_sorted, sorted_batches
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
            "observation": list(generator.integers(2, size=(n, 2)).astype("f4")),
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


@pytest.mark.parametrize("duplicates", DUPLICATES)
@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("session_by", ["gap", "session_id"])
def test_both_ways_keep_the_same_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, duplicates: str, text: bool, session_by: str
) -> None:
    monkeypatch.setattr("ucfrec.logs.engine.BATCH_ROWS", 64)
    path = tmp_path / "log.parquet"
    make_log(len(duplicates), text).to_parquet(path)
    with engine([path], tmp_path) as connection:
        tables = tuple(open_tables(connection, [path]))
        given = LogMapping(), "reward", session_by, tmp_path, duplicates
        log = check_rows(connection, tables, *given)
        columns = ("timestamp", "reward", "propensity", "is_random", "observation")
        order = "user_id, timestamp, item_id"
        expected = connection.sql(
            f"SELECT dense_rank() OVER (ORDER BY user_id) AS u, "
            f"dense_rank() OVER (ORDER BY item_id) AS i, {', '.join(columns)} FROM clean "
            f"ORDER BY {order}"
        ).df()
        dropped = drop_counts(log)
    with engine([path], tmp_path) as connection:
        tables = tuple(open_tables(connection, [path]))
        log = typed_log(connection, tables, LogMapping(), "reward", session_by, tmp_path)
        rows = check_sorted(log, sorted_batches(log, None, tmp_path), duplicates, tmp_path)
        found = {name: rows.clean.read(name, 0, len(rows.clean)) for name in rows.clean.names}
    assert rows.dropped == dropped
    assert rows.read == 400
    assert 0 < rows.conflicts <= dropped["duplicate"]
    for name in columns:
        values = np.stack(expected[name].tolist()).astype(found[name].dtype)
        np.testing.assert_array_equal(found[name], values)
    for name, ranks in (("user", "u"), ("item", "i")):
        _, places = np.unique(found[name], return_inverse=True)
        np.testing.assert_array_equal(places, expected[ranks] - 1)
