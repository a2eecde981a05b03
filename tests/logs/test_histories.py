"""Histories read from files, by sorting them, are those that SQL finds in a frame."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from ucfrec.errors import InputError
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import LogMapping

START = 1_700_000_000_000


def make_log(text: bool) -> pd.DataFrame:
    """Users of few and many rows, equal times, and rows that differ in their rewards only."""
    generator = np.random.default_rng(1)
    n = 600
    log = pd.DataFrame(
        {
            "user_id": generator.geometric(0.15, n) * 3,
            "item_id": generator.integers(9, size=n) * 2,
            "timestamp": START + generator.integers(200, size=n),
            "reward": generator.normal(size=n),
            "session_id": generator.integers(4, size=n),
            "observation": list(generator.normal(size=(n, 3)).astype("f4")),
        }
    )
    if text:
        for name in ("user_id", "item_id", "session_id"):
            log[name] = name[0] + log[name].astype("string")
    return log


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("block", [1, 50, 10**6])
@pytest.mark.parametrize("session_by", ["user", "session_id"])
def test_files_and_frames_have_the_same_histories(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: bool, block: int, session_by: str
) -> None:
    monkeypatch.setattr("ucfrec.logs.spool.BLOCK", block)
    log = make_log(text)
    log.to_parquet(tmp_path / "log.parquet")
    given = LogMapping(), "reward * 2", 7
    batches = list(read_histories([tmp_path / "log.parquet"], *given, session_by=session_by))
    assert len(batches) > 1 or block > 600
    found = pa.Table.from_batches(batches).to_pylist()
    by_sql = frame_histories(log, *given, session_by=session_by)
    expected = pa.Table.from_batches(by_sql).to_pylist()
    for ours, theirs in zip(found, expected, strict=True):
        # Numbers stand for the sessions.
        for history in (ours, theirs):
            ids = history.pop("session_ids", [])
            history["same"] = [each == ids[-1] for each in ids]
        assert ours == theirs


def test_logs_without_items_are_refused(tmp_path: Path) -> None:
    log = make_log(text=False).drop(columns=["item_id"])
    log["action"] = log["observation"]
    log.to_parquet(tmp_path / "log.parquet")
    with pytest.raises(InputError, match="its actions are vectors; map item_id"):
        list(read_histories([tmp_path / "log.parquet"], LogMapping(), "reward", 7))
