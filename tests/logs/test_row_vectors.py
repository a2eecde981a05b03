"""Observations of rows are fetched in any order, and a sort needs no memory for them."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ucfrec.logs.engine import engine
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.row_vectors import RowVectors
from ucfrec.logs.sorted_rows import check_sorted, sorted_batches
from ucfrec.logs.tables import open_tables
from ucfrec.logs.typed import typed_log

START = 1_700_000_000_000


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


def test_rows_have_their_own_observations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ucfrec.logs.engine.BATCH_ROWS", 64)
    file, asked = tmp_path / "log.parquet", np.array([500, 1, 2, 2, 77])
    numbers = write_log(file, 500, 3)
    with engine([file], tmp_path) as connection:
        tables = tuple(open_tables(connection, [file]))
        log = typed_log(connection, tables, LogMapping(), "reward", "user", tmp_path)
        vectors = RowVectors(log, tmp_path / "observations.bin")
        np.testing.assert_array_equal(vectors.of(asked), numbers[asked - 1])
        (batch,) = vectors.joined(iter([pa.record_batch({"row": asked})]))
        found = np.asarray(batch.column("observation").flatten()).reshape(-1, 3)
        np.testing.assert_array_equal(found, numbers[asked - 1])
        assert not (tmp_path / "observations.bin").exists()


def test_long_rows_are_sorted_in_less_memory_than_they_take(tmp_path: Path) -> None:
    file = tmp_path / "log.parquet"
    numbers = write_log(file, 20_000, 1024)
    assert numbers.nbytes > 80e6
    with engine([file], tmp_path, "40MB", threads=1) as connection:
        tables = tuple(open_tables(connection, [file]))
        log = typed_log(connection, tables, LogMapping(), "reward", "user", tmp_path)
        rows = check_sorted(log, sorted_batches(log, None, tmp_path), "highest", tmp_path)
        order = np.lexsort((np.arange(20_000), np.arange(20_000) % 7))
        found = rows.clean.read("observation", 9_000, 9_100)
        np.testing.assert_array_equal(found, numbers[order[9_000:9_100]])
