"""Times mean what the file says, or are asked about; never guessed."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.support.logs import random_log, write
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import LogMapping, read_mapping
from ucfrec.logs.prepare import validate


def make_log(times: "pd.Series[str] | pd.DatetimeIndex | pd.Index[str]") -> pd.DataFrame:
    return random_log(len(times), users=10).assign(timestamp=times)


def days(begin: str, n: int, rows: int = 3000) -> pd.DatetimeIndex:
    return pd.DatetimeIndex(
        pd.Timestamp(begin) + pd.to_timedelta(np.arange(rows) * (n * 86_400 / rows), unit="s")
    ).floor("s")


def range_of(path: Path, mapping: LogMapping | None = None) -> list[str]:
    report = validate([path], mapping or LogMapping())
    return [f"{pd.Timestamp(each, unit='ms'):%Y-%m-%d}" for each in report["time_range_ms"]]


@pytest.mark.parametrize(
    ("suffix", "sign", "clock"), [(".csv", "/", ""), (".parquet", "-", " %I:%M:%S %p")]
)
def test_an_order_of_day_and_month_that_no_row_settles_can_be_said(
    tmp_path: Path, suffix: str, sign: str, clock: str
) -> None:
    written = f"%m{sign}%d{sign}%Y{clock}"
    path = write(make_log(days("2024-03-01", 11).strftime(written)), tmp_path / f"log{suffix}")
    assert range_of(path, LogMapping(time_format=written)) == ["2024-03-01", "2024-03-11"]
    other = f"%d{sign}%m{sign}%Y{clock}"
    assert range_of(path, LogMapping(time_format=other)) == ["2024-01-03", "2024-11-03"]


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("2024-05-01T10:00:00+02:00", "2024-05-01 08:00:00"),
        ("2024-05-01", "2024-05-01 00:00:00"),
        ("2024/05/01 10:00:00", "2024-05-01 10:00:00"),
        ("2024-05-01T10:00:00,5-0330", "2024-05-01 13:30:00.500"),
        ("2024/05/01 10:00 -03:30", "2024-05-01 13:30:00"),
        ("2024-05-01 10:00:00UTC", "2024-05-01 10:00:00"),
        ("1714557600000", "2024-05-01 10:00:00"),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".parquet", "frame"])
def test_iso_times_are_read_with_and_without_zone(
    tmp_path: Path, suffix: str, written: str, expected: str
) -> None:
    log = make_log(pd.Index([written] * 3)).assign(user_id=1, item_id=[1, 2, 3])
    if suffix == "frame":
        (batch,) = frame_histories(log, LogMapping(), "reward", 10)
    else:
        path = write(log, tmp_path / f"log{suffix}")
        (batch,) = read_histories([path], LogMapping(), "reward", 10)
    ms = round(pd.Timestamp(expected, tz="UTC").timestamp() * 1000)
    assert batch.timestamps.tolist() == [ms] * 3


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_other_text_and_whole_numbers_are_read_by_their_format(tmp_path: Path, suffix: str) -> None:
    times = days("2024-03-01", 11).strftime("%d %b %Y %H:%M")
    zoned = write(make_log(times + " +0200"), tmp_path / f"zoned{suffix}")
    mapping = LogMapping(time_format="%d %b %Y %H:%M %z")
    assert range_of(zoned, mapping) == ["2024-02-29", "2024-03-11"]
    numbers = days("2024-03-01", 11).strftime("%Y%m%d%H%M").astype("int64")
    path = write(make_log(numbers), tmp_path / f"numbers{suffix}")
    assert range_of(path, LogMapping(time_format="%Y%m%d%H%M")) == ["2024-03-01", "2024-03-11"]


def test_times_before_2000_are_read_when_asked_for(tmp_path: Path) -> None:
    path = write(make_log(days("1997-09-01", 200)), tmp_path / "log.parquet")
    expected = ["1997-09-01", "1998-03-19"]
    assert range_of(path, LogMapping(earliest="1997-09-01T00:00:00+00:00")) == expected
    (tmp_path / "m.toml").write_text('earliest = "1990-01-01"\ntime_format = "%Y"\n')
    assert range_of(path, read_mapping(tmp_path / "m.toml")) == expected
