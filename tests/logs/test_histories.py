"""Histories read from files, by sorting them, are those that SQL finds in a frame."""

from datetime import date, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from tests.support.logs import START, list_users, random_log
from ucfrec.errors import InputError
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import LogMapping


def make_log(text: bool) -> pd.DataFrame:
    """Users of few and many rows, equal times, and rows that differ in their rewards only."""
    generator = np.random.default_rng(1)
    n = 600
    columns = {
        "user_id": generator.geometric(0.15, n) * 3,
        "item_id": generator.integers(9, size=n) * 2,
        "timestamp": START + generator.integers(200, size=n),
        "reward": generator.normal(size=n),
        "session_id": generator.integers(4, size=n),
        "observation": list(generator.normal(size=(n, 3)).astype("f4")),
    }
    log = pd.DataFrame(columns)
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
    monkeypatch.setattr("ucfrec.logs.typed.BATCH_ROWS", block)
    log = make_log(text)
    log.to_parquet(tmp_path / "log.parquet")
    given = LogMapping(), "reward * 2", 7
    batches = list(read_histories([tmp_path / "log.parquet"], *given, session_by=session_by))
    assert len(batches) > 1 or block > 600
    found = list_users(batches)
    expected = list_users(frame_histories(log, *given, session_by=session_by))
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


@pytest.mark.parametrize(
    ("name", "values", "told"),
    [
        # Arrow makes a column of dates of it, without the time of day.
        ("timestamp", [date(2024, 1, 1), datetime(2024, 1, 2, 10)], "holds dates and times"),
        ("user_id", [1, 2**64], "holds whole numbers of more than 64 bits"),
        ("item_id", [Decimal(1), Decimal("Infinity")], "holds values of several types"),
    ],
)
def test_columns_of_objects_that_arrow_would_change_or_not_take_are_refused(
    name: str, values: list[object], told: str
) -> None:
    frame = random_log(2).assign(**{name: pd.Series(values, dtype=object)})
    with pytest.raises(InputError, match=f"^histories: {name} {told}"):
        list(frame_histories(frame, LogMapping(), "reward", 7))


def test_a_column_that_cannot_be_converted_is_refused_only_if_it_is_read() -> None:
    periods = pd.Series(pd.period_range("2020", periods=2)).astype("category")
    arrays = {
        "halves": pa.array([[np.float16(1)], None]),
        "wide": pa.array([Decimal(1), None], pa.decimal256(50, 3)),
        "nothing": pa.array([{}, {}], pa.struct([])),
        "spans": pa.array([(1, 2, 3), None], pa.month_day_nano_interval()),
    }
    pairs = pd.Series([(1, 2), (1, 3)]).astype("category")
    kinds = {"cut": pd.cut(pd.Series([1, 2]), 2), "period": periods, "pairs": pairs}
    for name, values in arrays.items():
        kinds[name] = pd.Series(pd.arrays.ArrowExtensionArray(pa.chunked_array([values])))
    for name, column in kinds.items():
        frame = random_log(2, users=1).assign(**{name: column}, reward=np.array([0.5, 1], "f2"))
        (batch,) = frame_histories(frame, LogMapping(), "reward", 7)
        assert batch.rewards.tolist() == [0.5, 1.0]
        mapping = LogMapping(where=f"len({name}) > 1")
        with pytest.raises(InputError, match=f"histories: {name} is of type .*convert it"):
            list(frame_histories(frame, mapping, "reward", 7))
