"""CPU time of `update` with 10,000 new rows, on stores of more and more old ones.

    python benchmarks/update_time.py --rows 1000000 --rows 10000000

Random logs of 50,000 users and 1,000 items in sessions of ten; DT of width 16 with 80 steps, no
choice of the rule. What grows with the old rows is what an update reads of all of them.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.updating.update import update_run

SETTINGS = ("train.steps=80", "policy.dim=16", "policy.context=5", "rule.choose=false")
START_MS, MONTH_MS = 1_600_000_000_000, 30 * 86_400_000
USERS, ITEMS, LENGTH, NEW = 50_000, 1000, 10, 10_000


def log(rows: int, start: int, seed: int) -> pd.DataFrame:
    """Sessions of ten rows within a month."""
    rng, sessions = np.random.default_rng(seed), rows // LENGTH
    begin = start + np.sort(rng.integers(MONTH_MS, size=sessions))
    return pd.DataFrame(
        {
            "user_id": np.repeat(rng.integers(USERS, size=sessions), LENGTH),
            "item_id": rng.integers(ITEMS, size=rows),
            "timestamp": np.repeat(begin, LENGTH) + np.tile(np.arange(LENGTH) * 1000, sessions),
            "click": (rng.random(rows) < 0.2).astype(np.int8),
        }
    )


def seconds(folder: Path, rows: int) -> tuple[float, float]:
    """CPU time of the training on `rows` rows, and of the update."""
    log(rows, START_MS, 0).to_parquet(folder / "old.parquet")
    log(NEW, START_MS + MONTH_MS, 1).to_parquet(folder / "new.parquet")
    prepare(
        [folder / "old.parquet"], LogMapping(), folder / "store", PrepareOptions(reward="click")
    )
    began = time.process_time()
    config = resolve_config("dt", None, SETTINGS)
    train_run(EpisodeStore.open(folder / "store"), folder / "run", config)
    trained = time.process_time()
    update_run(folder / "run", [folder / "new.parquet"], folder / "run2", store=folder / "store2")
    return trained - began, time.process_time() - trained


def main() -> None:
    parser = argparse.ArgumentParser(description="CPU time of an update.")
    parser.add_argument("--rows", type=int, action="append", metavar="N")
    lines = []
    for rows in parser.parse_args().rows or [1_000_000, 10_000_000]:
        with tempfile.TemporaryDirectory() as folder:
            training, update = seconds(Path(folder), rows)
        lines.append((f"{rows:,}", f"{training:.1f}", f"{update:.1f}"))
    print(markdown_table(("old rows", "train, CPU s", "update, CPU s"), lines))


if __name__ == "__main__":
    main()
