"""Columns of files as expressions compute with them: no overflow, nothing undefined taken for a
value."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import LogMapping

START = 1_700_000_000_000


def rewards_of(columns: dict[str, object], reward: str, folder: Path) -> list[float]:
    """Rewards of rows in order, undefined ones left out; checks that a frame gives the same."""
    frame = pd.DataFrame(columns)
    frame = frame.assign(user_id=1, item_id=2, timestamp=START + np.arange(len(frame)))
    frame.to_parquet(folder / "log.parquet")
    (batch,) = read_histories([folder / "log.parquet"], LogMapping(), reward, last=len(frame))
    found: list[float] = batch["rewards"][0].as_py()
    if len(found) == len(frame):
        (batch,) = frame_histories(frame, LogMapping(), reward, last=len(frame))
        assert batch["rewards"][0].as_py() == found
    return found


NARROW = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")


@pytest.mark.parametrize("kind", NARROW)
@pytest.mark.parametrize(
    ("reward", "wanted"),
    [
        ("a * b", [10_000.0, 30.0]),
        ("a * a * a * a * a", [1e10, 243.0]),
        ("a - 2 * b", [-100.0, -17.0]),
        ("least(a + b, 250)", [200.0, 13.0]),
    ],
)
def test_integers_of_any_width_do_not_overflow(
    kind: str, reward: str, wanted: list[float], tmp_path: Path
) -> None:
    columns = {"a": np.array([100, 3], dtype=kind), "b": np.array([100, 10], dtype=kind)}
    assert rewards_of(columns, reward, tmp_path) == wanted


def test_lists_of_narrow_integers_do_not_overflow(tmp_path: Path) -> None:
    counts = [np.array([100, 100], dtype="int8"), np.array([3, 2], dtype="int8")]
    assert rewards_of({"n": counts}, "n[1] * n[2]", tmp_path) == [10_000.0, 6.0]


def test_narrow_seconds_are_times(tmp_path: Path) -> None:
    frame = pd.DataFrame({"user_id": 1, "item_id": [2, 3], "reward": [0.0, 1.0]})
    frame["seconds"] = np.array([START // 1000] * 2, dtype="int32")
    frame.to_parquet(tmp_path / "log.parquet")
    mapping = LogMapping({"timestamp": "seconds * 1000"})
    (batch,) = read_histories([tmp_path / "log.parquet"], mapping, "reward", last=2)
    assert batch["timestamps"][0].as_py() == [START, START]
