"""The KuaiRand environment: click probabilities completed from the rows of an evaluation window.

`python -m ucfrec_simulators.kuai.kuairand STORE VIDEO_FEATURES_BASIC --out FOLDER` makes its files
from a store of that window.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec_simulators.kuai.behaviors import simulators
from ucfrec_simulators.kuai.completion import ITEMS_FILE, USERS_FILE, Completed, complete
from ucfrec_simulators.kuai.environment import EXITS, REGIMES, ExitRule, KuaiEnv, Regime
from ucfrec_simulators.kuai.kuairec import parse_tags, read_columns
from ucfrec_simulators.session_env import data_folder

SOURCE: Final = "https://kuairand.com (data/video_features_basic_*)"
MAKE_IT: Final = "make them with `python -m ucfrec_simulators.kuai.kuairand`, or name their folder"


def kuairand(
    num_envs: int,
    folder: Path | None = None,
    exit_rule: ExitRule = EXITS["easyrl4rec-kuairand"],
    regime: Regime = REGIMES["FB"],
) -> KuaiEnv:
    """The environment of KuaiRand's users × videos; the reward is the probability of a click.
    InputError if a file is missing.

    Args:
        folder: written by `ucfrec_simulators.kuai.completion.complete`; None for
            `kuairand-environment` in the data folder.
    """
    folder = folder or data_folder("kuairand-environment")
    for name in (USERS_FILE, ITEMS_FILE):
        if not (folder / name).is_file():
            raise InputError(f"{folder / name} is missing; {MAKE_IT}")
    users, items = pq.read_table(folder / USERS_FILE), pq.read_table(folder / ITEMS_FILE)
    columns = [table["vector"].combine_chunks() for table in (users, items)]
    of_users, of_items = (np.asarray(v.flatten()).reshape(len(v), -1) for v in columns)
    table, tags = Completed(of_users, of_items), items["tags"].to_pylist()
    user_ids, item_ids = np.asarray(users[schema.USER_ID]), np.asarray(items[schema.ITEM_ID])
    return KuaiEnv(num_envs, table, tags, exit_rule, regime, user_ids, item_ids)


def read_tags(path: Path) -> dict[int, tuple[int, ...]]:
    """Tags of each video of a `video_features_basic` file; a video may have none. InputError if the
    file is missing or is not the official one."""
    table = read_columns(path, ["video_id", "tag"], SOURCE)
    tags = table["tag"].fillna("").astype(str)
    return {video: parse_tags(text) for video, text in zip(table["video_id"], tags, strict=True)}


SIMULATOR, SIMULATOR_NX_0, SIMULATOR_NX_10, *_SHORTER = simulators(
    kuairand, EXITS["easyrl4rec-kuairand"], "KuaiRand's videos, completed click rates", "is_click"
)
SIMULATOR_N4, SIMULATOR_N4_NX_0, SIMULATOR_N1, SIMULATOR_N1_NX_0 = _SHORTER


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the environment's files from the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m ucfrec_simulators.kuai.kuairand")
    parser.add_argument("store", type=Path, help="store of the evaluation window, reward is_click")
    parser.add_argument("video_features_basic", type=Path, help="the official file, for the tags")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    try:
        tags = read_tags(options.video_features_basic)
        report = complete(EpisodeStore.open(options.store), tags, options.out, seed=options.seed)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(
        f"{options.out}: {report.users} users × {report.items} items from {report.rows} rows; on "
        f"{report.held_out_rows} later rows AUC {report.auc:.3f}, log loss {report.log_loss:.4f} "
        f"(constant click rate {report.base_log_loss:.4f}), calibration error "
        f"{report.calibration_error:.3f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
