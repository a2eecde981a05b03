"""A reader of logs of its own, with pandas: identifiers are text, parts are joined by name."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

Rows = dict[str, list[tuple[int, str, float]]]
"""User to (time in ms, item, reward) of their rows, sorted."""
_EPOCH = pd.Timestamp("1970-01-01", tz="UTC")


def rows_of(files: Sequence[tuple[Path, str]]) -> Rows:
    """The rows that a log has, of rows with one user, item and time that with the highest reward.

    Each file is Parquet or CSV, with the format of its times: "ms", "iso", or of `strptime`.
    """
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
