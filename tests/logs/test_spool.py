"""Rows on disk come back as they were."""

from pathlib import Path

import numpy as np
import pytest

from ucfrec.logs.spool import BLOCK, Spool


@pytest.mark.parametrize("on_disk", [True, False])
def test_slices_of_rows_come_back(tmp_path: Path, on_disk: bool) -> None:
    spool = Spool(tmp_path / "rows" if on_disk else None)
    vectors = np.arange(30, dtype=np.float32).reshape(10, 3)
    for begin, end in ((0, 4), (4, 4), (4, 10)):
        spool.append({"v": vectors[begin:end], "n": np.arange(begin, end)})
    assert (len(spool), spool.names) == (10, ("v", "n"))
    np.testing.assert_array_equal(spool.read("v", 2, 7), vectors[2:7])
    np.testing.assert_array_equal(spool.read("n", 9, 10), [9])
    assert len(spool.read("v", 3, 3)) == 0
    # Reading and appending can take turns.
    spool.append({"v": vectors[:1], "n": np.array([10])})
    np.testing.assert_array_equal(spool.read("n", 8, 11), [8, 9, 10])


def test_fewer_long_rows_are_in_memory(tmp_path: Path) -> None:
    short, long = Spool(tmp_path / "short"), Spool(tmp_path / "long")
    short.append({"user": np.zeros(3, dtype=np.int64)})
    long.append({"user": np.zeros(3, dtype=np.int64), "seen": np.zeros((3, 4096), dtype="f4")})
    assert short.block_rows == BLOCK
    assert 0 < long.block_rows * (8 + 4 * 4096) <= 2**26
