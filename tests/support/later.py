"""Later rows of the log of `tests.support.tagged`, with new users and new items."""

from pathlib import Path

import numpy as np
import pandas as pd

from tests.support.tagged import ITEMS, USERS, tagged_log
from ucfrec.logs.mapping import FeatureTable, LogMapping

NEW = 6
"""New items, and as many new users."""


def later_log(rows: int = 300, seed: int = 1, propensity: bool = False) -> pd.DataFrame:
    """Rows after those of `tagged_log`."""
    rng, start = np.random.default_rng(seed), tagged_log().timestamp.max()
    log = pd.DataFrame({"user_id": rng.integers(USERS + NEW, size=rows) + 100})
    log["item_id"] = rng.integers(ITEMS + NEW, size=rows)
    log["timestamp"] = start + 43_200_001 * seed + np.cumsum(rng.integers(1, 60_000, size=rows))
    log["reward"] = (rng.random(rows) < 0.2 + 0.5 * (log.item_id % 4 == log.user_id % 4)) * 1.0
    return log.assign(propensity=1 / (ITEMS + NEW)) if propensity else log


def later_mapping(folder: Path) -> LogMapping:
    """Feature tables of all users and items, in files of their own."""
    tags = [[f"t{item % 4}", f"u{item % 3}"][: 1 + item % 2] for item in range(ITEMS + NEW)]
    items = pd.DataFrame({"item_id": range(ITEMS + NEW), "tags": tags})
    items.to_parquet(folder / "later_items.parquet")
    ages = np.arange(USERS + NEW) * 1.0
    users = pd.DataFrame({"user_id": range(100, 100 + len(ages)), "age": ages})
    users.to_parquet(folder / "later_users.parquet")
    return LogMapping(
        item_features=(FeatureTable((folder / "later_items.parquet",), "item_id"),),
        user_features=(FeatureTable((folder / "later_users.parquet",), "user_id"),),
    )
