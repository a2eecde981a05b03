"""Later rows of the log of `tests.support.tagged`, with new users and new items."""

from pathlib import Path

import numpy as np
import pandas as pd

from tests.support.tagged import ITEMS, USERS, tagged_log, tagged_mapping
from ucfrec.logs.mapping import LogMapping

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
    return tagged_mapping(folder, NEW, "later_")
