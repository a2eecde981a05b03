"""The KuaiRec environment: the nearly fully observed users × videos of `small_matrix`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from ucfrec.errors import InputError
from ucfrec_simulators.kuai.behaviors import simulators
from ucfrec_simulators.kuai.environment import EXITS, REGIMES, ExitRule, KuaiEnv, Regime
from ucfrec_simulators.session_env import data_folder

REWARD_CAP: Final = 5.0
CATEGORIES: Final = "item_categories.csv"
SOURCE: Final = "https://kuairec.com (KuaiRec.zip, folder data)"


def kuairec(
    num_envs: int,
    folder: Path | None = None,
    exit_rule: ExitRule = EXITS["easyrl4rec-kuairec"],
    regime: Regime = REGIMES["FB"],
) -> KuaiEnv:
    """The environment of 1,411 users × 3,327 videos.

    The reward is the raw `watch_ratio`, clipped at 5, and 0 for the 0.4% of pairs that were never
    observed. InputError if a file is missing or is not the official one, or a video has no
    categories.

    Args:
        folder: has `small_matrix.csv` and `item_categories.csv`; None for `kuairec` in the data
            folder.
    """
    folder = folder or data_folder("kuairec")
    watched = read_columns(
        folder / "small_matrix.csv", ["user_id", "video_id", "watch_ratio"], SOURCE
    )
    users, rows = np.unique(watched["user_id"].to_numpy(), return_inverse=True)
    items, columns = np.unique(watched["video_id"].to_numpy(), return_inverse=True)
    rewards = np.zeros((len(users), len(items)), dtype=np.float32)
    watch_ratios = np.nan_to_num(watched["watch_ratio"].to_numpy(), nan=0.0)
    rewards[rows, columns] = np.clip(watch_ratios, 0.0, REWARD_CAP)
    categories = read_categories(folder)
    missing = [item for item in items if item not in categories]
    if missing:
        raise InputError(
            f"{folder / CATEGORIES} lacks {len(missing)} videos such as {missing[0]}; see {SOURCE}"
        )
    tags = [categories[item] for item in items]
    return KuaiEnv(num_envs, rewards, tags, exit_rule, regime, users, items)


def read_categories(folder: Path) -> dict[int, tuple[int, ...]]:
    """Categories of every video of the official `item_categories.csv` in `folder`. InputError if
    the file is missing or is not the official one."""
    table = read_columns(folder / CATEGORIES, ["video_id", "feat"], SOURCE)
    categories = (parse_tags(text.strip("[]")) for text in table["feat"])
    return dict(zip(table["video_id"], categories, strict=True))


def read_columns(path: Path, columns: Sequence[str], source: str) -> pd.DataFrame:
    """Read columns of a CSV file; `source` is where to get it, for the error message. InputError if
    the file is missing or lacks a column."""
    try:
        return pd.read_csv(path, usecols=list(columns))
    except FileNotFoundError:
        raise InputError(f"{path} is missing; get it from {source}, or name its folder") from None
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path} is not the official file ({reason}); see {source}") from None


def parse_tags(text: str) -> tuple[int, ...]:
    """Parse numbers separated by commas: "27, 9" gives (27, 9)."""
    return tuple(int(tag) for tag in text.split(",") if tag.strip())


SIMULATOR, SIMULATOR_NX_0, SIMULATOR_NX_10, *_SHORTER = simulators(
    kuairec,
    EXITS["easyrl4rec-kuairec"],
    "KuaiRec's fully observed videos, watch ratio",
    "watch_ratio",
)
SIMULATOR_N4, SIMULATOR_N4_NX_0, SIMULATOR_N1, SIMULATOR_N1_NX_0 = _SHORTER
