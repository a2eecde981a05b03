"""Logs as files, and the stores made of them."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare

START = 1_700_000_000_000
"""Time of the first row of `random_log`, in ms."""


def random_log(
    rows: int = 400, users: int = 100, items: int = 20, step: int = 600_000
) -> pd.DataFrame:
    """One row every `step` ms, of random users and items; three in ten have the reward 1."""
    generator = np.random.default_rng(0)
    log = pd.DataFrame({"user_id": generator.integers(users, size=rows)})
    log["item_id"] = generator.integers(items, size=rows)
    log["timestamp"] = START + step * np.arange(rows)
    log["reward"] = (generator.random(rows) < 0.3) * 1.0
    return log


def write(frame: pd.DataFrame, path: Path) -> Path:
    """Write a CSV or Parquet file, as its name says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".csv":
        frame.to_csv(path, index=False)
    else:
        frame.to_parquet(path, index=False)
    return path


def store_of(
    log: pd.DataFrame, folder: Path, mapping: LogMapping | None = None, **options: Any
) -> EpisodeStore:
    """The store of a log, at `folder / "store"`, beside the log as a file."""
    log.to_parquet(folder / "log.parquet")
    given = mapping or LogMapping(), folder / "store", PrepareOptions(**options)
    prepare([folder / "log.parquet"], *given)
    return EpisodeStore.open(folder / "store")
