"""A log of items with tags and of users with features, as a file and as a store."""

from pathlib import Path

import numpy as np
import pandas as pd

from tests.support.logs import store_of
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import FeatureTable, LogMapping

ITEMS, USERS = 24, 30


def tagged_log(rows: int = 900, seed: int = 0) -> pd.DataFrame:
    """Sessions of about 7 steps; tags repeat, users like some tags better."""
    rng = np.random.default_rng(seed)
    log = pd.DataFrame({"user_id": rng.integers(USERS, size=rows) + 100})
    log["item_id"] = np.minimum(rng.integers(ITEMS, size=rows), rng.integers(ITEMS, size=rows))
    log["timestamp"] = 1_700_000_000_000 + np.cumsum(rng.integers(1, 60_000, size=rows))
    log["reward"] = (rng.random(rows) < 0.2 + 0.5 * (log.item_id % 4 == log.user_id % 4)) * 1.0
    return log


def tagged_mapping(folder: Path) -> LogMapping:
    """Mapping to feature tables, which are written to `folder`."""
    tags = [[f"t{item % 4}", f"u{item % 3}"][: 1 + item % 2] for item in range(ITEMS)]
    pd.DataFrame({"item_id": range(ITEMS), "tags": tags}).to_parquet(folder / "items.parquet")
    users = pd.DataFrame({"user_id": range(100, 100 + USERS), "age": np.arange(USERS) * 1.0})
    users.to_parquet(folder / "users.parquet")
    return LogMapping(
        item_features=(FeatureTable((folder / "items.parquet",), "item_id"),),
        user_features=(FeatureTable((folder / "users.parquet",), "user_id"),),
    )


def tagged_store(folder: Path, **columns: float) -> EpisodeStore:
    """The store of `tagged_log`, at `folder / "store"`, beside its log and tables.

    Args:
        columns: more columns of the log, each of one value.
    """
    return store_of(
        tagged_log().assign(**columns),
        folder,
        tagged_mapping(folder),
        reward="reward",
        session_by="gap",
        gap_minutes=120,
        embedding_size=6,
    )
