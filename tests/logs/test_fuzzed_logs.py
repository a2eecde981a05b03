"""Logs of every make mean to ucfrec what they mean to an independent reader, or are refused."""

import gzip
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from tests.support.logs import list_users
from ucfrec.errors import InputError, InputNote
from ucfrec.logs.histories import read_histories
from ucfrec.logs.mapping import LogMapping

START = pd.Timestamp("2024-02-20T00:00:00")
WORDS = ["7", "07", "007", "7.0", "1e1", "10", "1_0", "0x1f", "31", "+7", "-7", "7 ", "NA", "null"]
WORDS += ["true", "a,b", 'q"x', "é", "2024-01-01", "9223372036854775808", "line\nbreak"]
WORDS += ["'7'", "-0"]
MONTH_FIRST = "%m/%d/%Y %H:%M:%S"
_EPOCH = pd.Timestamp("1970-01-01", tz="UTC")
FOLDERS = ["", "user_id=7", "date=2024-03-01", "reward=1/item_id=x"]
Rows = dict[str, list[tuple[int, str, float]]]
"""User to (time in ms, item, reward) of their rows, sorted."""


@dataclass(frozen=True)
class Part:
    """A file of a log."""

    frame: pd.DataFrame
    folder: str
    suffix: str
    written: str
    """Times: "ms", "iso", or a format of `strptime`."""
    encoding: str


@st.composite
def parts(draw: st.DrawFn) -> Part:
    """A part in some layout: names, types, order of the columns, times, encoding."""
    rows = draw(st.integers(0, 12))
    suffix = draw(st.sampled_from([".parquet", ".csv", ".csv.gz"]))
    numbers = draw(st.booleans())
    ids = st.integers(-3, 12) if numbers else st.sampled_from(WORDS)
    written = draw(st.sampled_from(["ms", "iso", "iso", "zoned", MONTH_FIRST]))
    columns: dict[str, object] = {}
    for name in ("user_id", "item_id"):
        values = draw(st.lists(ids, min_size=rows, max_size=rows))
        missing = draw(st.lists(st.integers(0, 19), min_size=rows, max_size=rows))
        kept = [None if gap == 0 else value for value, gap in zip(values, missing, strict=True)]
        columns[name] = pd.array(kept, dtype="Int64" if numbers else "string")
    minutes = draw(st.lists(st.integers(0, 60 * 24 * 40), min_size=rows, max_size=rows))
    times = pd.DatetimeIndex([START + pd.Timedelta(minutes=each) for each in minutes])
    columns["timestamp"] = as_written(times, written, draw, suffix == ".parquet")
    kind = draw(st.sampled_from(["floats", "numbers", "truth", "missing"]))
    columns["reward"] = {
        "floats": [n / 4 - 1 for n in range(rows)],
        "numbers": list(range(rows)),
        "truth": [n % 3 == 0 for n in range(rows)],
        "missing": [None if n % 2 else 0.5 * n for n in range(rows)],
    }[kind]
    if draw(st.booleans()):
        columns["more"] = ["x"] * rows
    frame = pd.DataFrame(columns)[draw(st.permutations(list(columns)))]
    changed = draw(st.sampled_from([str.lower, str.upper, str.title]))
    encoding = draw(st.sampled_from(["utf-8", "utf-8", "utf-8-sig", "latin-1"]))
    return Part(
        frame.rename(columns=changed),
        draw(st.sampled_from(FOLDERS)),
        suffix,
        "iso" if written == "zoned" else written,
        "utf-8" if suffix == ".parquet" else encoding,
    )


def as_written(
    times: pd.DatetimeIndex, written: str, draw: st.DrawFn, may_be_typed: bool
) -> object:
    if written == "ms":
        return (times - pd.Timestamp(0)) // pd.Timedelta(milliseconds=1)
    if written == "iso":
        if may_be_typed and draw(st.booleans()):
            return times.as_unit(draw(st.sampled_from(["ms", "us", "ns"])))
        return times.strftime(draw(st.sampled_from(["%Y-%m-%dT%H:%M:%S", "%Y-%m-%d %H:%M:%S"])))
    if written == "zoned":
        zone = draw(st.sampled_from(["UTC", "Asia/Tokyo", "-03:30"]))
        return [each.tz_localize("UTC").tz_convert(zone).isoformat() for each in times]
    return times.strftime(written)


def write(part: Part, folder: Path, number: int) -> Path:
    path = folder / part.folder / f"{number}{part.suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    if part.suffix == ".parquet":
        part.frame.to_parquet(path, index=False)
        return path
    text = part.frame.to_csv(index=False).encode(part.encoding)
    path.write_bytes(gzip.compress(text) if part.suffix == ".csv.gz" else text)
    return path


def rows_of(files: Sequence[tuple[Path, str]]) -> Rows:
    """The rows that a log has, of rows with one user, item and time that with the highest reward.
    Files are Parquet or CSV, with times in "ms", in "iso" or in a format of `strptime`."""
    frames = [_part(path, written) for path, written in files]
    log = pd.concat(frames, ignore_index=True)
    log = log[np.isfinite(log["reward"].astype(float))].dropna()
    log = log.sort_values("reward").drop_duplicates(["user", "item", "time"], keep="last")
    found: Rows = {}
    for user, item, time, reward in log.itertuples(index=False):
        found.setdefault(user, []).append((int(time), item, float(np.float32(reward))))
    return {user: sorted(rows) for user, rows in found.items()}


def _part(path: Path, written: str) -> pd.DataFrame:
    if path.suffix == ".parquet":
        frame = pd.read_parquet(path)
    else:
        frame = pd.read_csv(path, dtype=str, keep_default_na=False, na_values=[""])
    frame.columns = [str(name).lower() for name in frame.columns]
    columns = {name: map(_text, frame[f"{name}_id"]) for name in ("user", "item")}
    times = [_time(each, written) for each in frame["timestamp"]]
    return pd.DataFrame({**columns, "time": times, "reward": map(_number, frame["reward"])})


def _text(given: object) -> str | None:
    return None if pd.isna(given) else str(given)


def _time(given: object, written: str) -> int | None:
    if pd.isna(given):
        return None
    if written == "ms":
        return int(str(given))
    if written == "iso" or isinstance(given, pd.Timestamp):
        time = pd.Timestamp(str(given))
    else:
        time = pd.to_datetime(str(given), format=written)
    time = time.tz_localize("UTC") if time.tz is None else time.tz_convert("UTC")
    return int((time - _EPOCH) // pd.Timedelta(milliseconds=1))


def _number(given: object) -> float:
    if pd.isna(given):
        return np.nan
    words = {"True": 1.0, "False": 0.0, "true": 1.0, "false": 0.0}
    return words[str(given)] if str(given) in words else float(str(given))


def may_be_refused(given: list[Part], expected: Rows) -> bool:
    """Whether a log is one that must or may be asked about."""
    asked = [part for part in given if "%" in part.written]
    latin = any(part.encoding == "latin-1" and "é" in part.frame.to_csv() for part in given)
    return bool(asked) or latin or not expected or all(part.frame.empty for part in given)


def check(given: list[Part], folder: Path) -> None:
    files = [(write(part, folder, number), part.written) for number, part in enumerate(given)]
    readable = [
        (path, written)
        for (path, written), part in zip(files, given, strict=True)
        if part.encoding != "latin-1" or "é" not in part.frame.to_csv()
    ]
    expected = rows_of(readable) if readable else {}
    batches, refusal = [], ""
    try:
        batches = list(read_histories([folder], LogMapping(), "reward", 1000))
    except InputError as error:
        refusal = str(error)
    event("refused" if refusal else "read")
    if refusal:
        assert "\n" not in refusal
        assert may_be_refused(given, expected), refusal
        return
    assert not any("%" in part.written and len(part.frame) for part in given)
    found: Rows = {}
    for user in list_users(batches):
        steps = zip(user["timestamps"], map(str, user["item_ids"]), user["rewards"], strict=True)
        found[str(user["user_id"])] = sorted(steps)
    assert found == expected


@pytest.mark.parametrize("examples", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_fuzzed_logs_agree_with_pandas_or_are_refused(
    tmp_path_factory: pytest.TempPathFactory, examples: int
) -> None:
    # Other files when the test changes; the same ones for every change to merge.
    @settings(max_examples=examples, suppress_health_check=[HealthCheck.too_slow])
    @given(st.lists(parts(), min_size=1, max_size=4))
    def fuzzed(logs: list[Part]) -> None:
        check(logs, tmp_path_factory.mktemp("logs"))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputNote)
        fuzzed()
