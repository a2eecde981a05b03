"""Logs as files, and the stores made of them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.histories import Histories
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


def faulty_log(rows: int, text: bool, seed: int) -> pd.DataFrame:
    """Few keys, in no order, many duplicates that differ in some column, and every fault."""
    generator = np.random.default_rng(seed)
    log = pd.DataFrame(
        {
            "user_id": generator.integers(-2, 6, rows),
            "item_id": generator.integers(5, size=rows),
            "timestamp": START + generator.integers(8, size=rows) * 60_000,
            "reward": generator.choice([0, 1, 2, np.nan, np.inf, -np.inf], rows),
            "length": generator.integers(3, size=rows),
            "propensity": generator.choice([0.25, 0.5, np.nan], rows),
            "is_random": generator.integers(2, size=rows),
            "session_id": generator.integers(3, size=rows),
        }
    )
    log = log.astype({"user_id": "Int64", "item_id": "Int64"})
    if text:
        for name in ("user_id", "item_id", "session_id"):
            log[name] = "é" + log[name].astype("string")
    for name, value in (("user_id", None), ("item_id", None), ("timestamp", 5)):
        log.loc[generator.integers(rows, size=4), name] = value
    return log


def write(frame: pd.DataFrame, path: Path) -> Path:
    """Write a CSV or Parquet file, as its name says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    (frame.to_csv if path.suffix == ".csv" else frame.to_parquet)(path, index=False)
    return path


def store_of(
    log: pd.DataFrame, folder: Path, mapping: LogMapping | None = None, **options: Any
) -> EpisodeStore:
    """The store of a log, at `folder / "store"`, beside the log as a file."""
    log.to_parquet(folder / "log.parquet")
    given = mapping or LogMapping(), folder / "store", PrepareOptions(**options)
    prepare([folder / "log.parquet"], *given)
    return EpisodeStore.open(folder / "store")


def list_users(batches: Iterable[Histories]) -> list[dict[str, Any]]:
    """Each user of histories, with lists of their rows and the items that they have seen."""
    users = []
    for batch in batches:
        for number, user in enumerate(batch.users.tolist()):
            rows, seen = batch.owner == number, batch.seen_owner == number
            names = ("item_ids", "rewards", "timestamps", "session_ids")
            columns = {name: getattr(batch, name) for name in names}
            lists = {name: v[rows].tolist() for name, v in columns.items() if v is not None}
            lists["seen"] = batch.seen_ids[seen].tolist()
            if batch.observations is not None:
                lists["observation"] = batch.observations[number].tolist()
            users.append({"user_id": user} | lists)
    return users
