"""A training, and parts of the daily loop, in processes that are killed at random moments.

    python killed_loop.py run|update|promote|join|exposures FOLDER

Prints how many were killed. What a kill leaves is checked here, the end by the caller."""

import os
import random
import subprocess
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
from ucfrec.logs.join import join_feedback
from ucfrec.recommending.exposures import ExposureLog
from ucfrec.recommending.responder import Answer
from ucfrec.runs.promoted import promote, promoted
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.update import update_run

LIVES = 8  # of work that has no end


def update(folder: Path) -> None:
    """An update, until it is done."""
    with short_validation():
        logs, mapping = [folder / "later.parquet"], later_mapping(folder)
        update_run(folder / "run", logs, folder / "killed", mapping=mapping)


def promote_often(folder: Path) -> None:
    """Promote two runs in turn, for ever."""
    while True:
        for name in ("run", "other"):
            promote(folder / name, force=True)


def promoted_is_whole(folder: Path) -> None:
    found = promoted(folder)
    assert found.current in ("run", "other")
    TrainedPolicy.load(folder / found.current)


def join(folder: Path) -> None:
    """Join, until it is done; what a kill left is whole."""
    out, feedback = folder / "joined.parquet", [folder / "feedback.parquet"]
    assert not out.exists() or len(pd.read_parquet(out))
    join_feedback([folder / "shown"], feedback, out, 10**9)


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
        # What is lost is what was given since the last flush.
        assert -1 <= given - len(rows) // 2 < 2000


WORK: dict[str, tuple[Callable[[Path], None], Callable[[Path], None], float]] = {
    "run": (lambda at: killed_run.train(at / "store", at / "killed"), lambda at: None, 0.4),
    "join": (join, lambda folder: None, 0.1),
    "update": (update, lambda folder: None, 1.0),
    "promote": (promote_often, promoted_is_whole, 0.3),
    "exposures": (write_exposures, exposures_are_whole, 0.6),
}


def kills(work: str, folder: Path) -> int:
    """How many processes of some work were killed before it was done."""
    command = [sys.executable, __file__, work, folder]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(command, env=env, capture_output=True, text=True, timeout=900)
    assert ended.returncode == 0, ended.stderr
    return int(ended.stdout.split()[-1])


def main() -> None:
    torch.set_num_threads(1)
    optimizer_imported()
    (work, check, seconds), folder = WORK[sys.argv[1]], Path(sys.argv[2])
    moments, endless = random.Random(0), sys.argv[1] in ("promote", "exposures")
    for killed in count():
        longest = seconds if endless else seconds * 1.5**killed
        ended = life(work, folder, moments.uniform(0.1, 1.0) * longest)
        check(folder)
        if ended or (endless and killed == LIVES):
            break
    print(killed)


if __name__ == "__main__":
    main()
