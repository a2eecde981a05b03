"""A training, and parts of the daily loop, in processes that are killed at random moments.

    python killed_loop.py run|update|promote|exposures FOLDER

Prints how many were killed. What a kill leaves is checked here, the end by the caller."""

import random
import sys
import time
from collections.abc import Callable
from contextlib import closing
from itertools import count
from pathlib import Path

import pandas as pd
import torch

from tests.support import killed_run
from tests.support.killed_training import life, optimizer_imported
from tests.support.later import later_mapping
from tests.support.short_validation import short_validation
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.responder import Answer
from ucfrec.runs.promoted import promote, promoted
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.update import update_run

LIVES = 8
"""Of work that has no end."""


def update(folder: Path) -> None:
    """An update, until it is done."""
    mapping = later_mapping(folder)
    with short_validation():
        logs, out = [folder / "later.parquet"], folder / "killed"
        update_run(folder / "run", logs, out, mapping=mapping)


def promote_often(folder: Path) -> None:
    """Promote two runs in turn, for ever."""
    while True:
        for name in ("run", "other"):
            promote(folder / name, force=True)


def promoted_is_whole(folder: Path) -> None:
    found = promoted(folder)
    assert found.current in ("run", "other")
    TrainedPolicy.load(found.run(folder))


def write_exposures(folder: Path) -> None:
    """Answer for ever, and say how many answers were given."""
    trained, name = TrainedPolicy.load(folder / "run"), str(time.time_ns())
    given = (folder / f"given-{name}").open("w", buffering=1)
    with closing(ExposureLog(folder / "written", trained, rows=40, seconds=0.05)) as log:
        for number in count():
            log.add("u", Answer([1, 2], [0.0, 0.0], [0.5, 0.5], f"{name}-{number}", "r", "d"))
            given.write(f"{number}\n")
            time.sleep(0.001)


def exposures_are_whole(folder: Path) -> None:
    """Files are whole, and have the first answers of each life, each once."""
    frames = [pd.read_parquet(file) for file in (folder / "written").glob("*.parquet")]
    if not frames:
        return
    frame = pd.concat(frames)
    assert not frame.duplicated(["request_id", "position"]).any()
    lives, numbers = zip(*(each.split("-") for each in frame.request_id), strict=True)
    for name, rows in pd.Series(numbers).astype(int).groupby(list(lives)):
        given = len((folder / f"given-{name}").read_text().splitlines())
        assert sorted(rows) == sorted([*range(len(rows) // 2)] * 2)
        assert len(rows) // 2 <= given + 1
        # What is lost is what was given since the last flush.
        assert given - len(rows) // 2 < 2000


def run(folder: Path) -> None:
    """A whole run, until it is done."""
    killed_run.train(folder / "store", folder / "killed")


WORK: dict[str, tuple[Callable[[Path], None], Callable[[Path], None], float]] = {
    "run": (run, lambda folder: None, 0.4),
    "update": (update, lambda folder: None, 1.0),
    "promote": (promote_often, promoted_is_whole, 0.3),
    "exposures": (write_exposures, exposures_are_whole, 0.6),
}


def main() -> None:
    torch.set_num_threads(1)
    optimizer_imported()
    (work, check, seconds), folder = WORK[sys.argv[1]], Path(sys.argv[2])
    moments, endless = random.Random(0), sys.argv[1] in ("promote", "exposures")
    killed = 0
    while True:
        longest = seconds if endless else seconds * 1.5**killed
        ended = life(work, folder, moments.uniform(0.1, 1.0) * longest)
        check(folder)
        if ended or (endless and killed == LIVES):
            break
        killed += 1
    print(killed)


if __name__ == "__main__":
    main()
