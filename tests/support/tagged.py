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


def tagged_mapping(folder: Path, more: int = 0, prefix: str = "") -> LogMapping:
    """Mapping to feature tables, with `more` items and users, which are written to `folder`."""
    tags = [[f"t{item % 4}", f"u{item % 3}"][: 1 + item % 2] for item in range(ITEMS + more)]
    ages = np.arange(USERS + more) * 1.0
    items, users = (folder / f"{prefix}{name}.parquet" for name in ("items", "users"))
    pd.DataFrame({"item_id": range(len(tags)), "tags": tags}).to_parquet(items)
    pd.DataFrame({"user_id": range(100, 100 + len(ages)), "age": ages}).to_parquet(users)
    features = FeatureTable((items,), "item_id"), FeatureTable((users,), "user_id")
    return LogMapping(item_features=features[:1], user_features=features[1:])


def tagged_store(folder: Path, **columns: float) -> EpisodeStore:
    """The store of `tagged_log`, with more `columns` of one value each, beside log and tables."""
    log, options = tagged_log().assign(**columns), {"session_by": "gap", "gap_minutes": 120}
    own = {"reward": "reward", "embedding_size": 6, **options}
    return store_of(log, folder, tagged_mapping(folder), **own)
