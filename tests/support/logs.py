"""Logs as files, and the stores made of them."""

from pathlib import Path
from typing import Any

import pandas as pd

from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare


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
