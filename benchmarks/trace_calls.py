"""How many source files a command runs through, and how often it goes from one to another.

    python benchmarks/trace_calls.py                         # a tiny train, ope and recommend
    python benchmarks/trace_calls.py --top 20                # with the busiest pairs of files
    python benchmarks/trace_calls.py ope run logs.parquet    # any ucfrec command line

A file counts if a function or class body of it runs; what only importing it runs does not count. A
hop is a call of one of our functions, or the resumption of one of our generators, whose nearest
caller of ours lies in another file; calls by way of a library (`torch.nn.Module.__call__`) count.
Calls while a module is imported do not. Threads count, child processes do not.

The tiny job, always the same: a random log of 2,000 rows, 100 users and 30 items with propensities;
UCF of width 16, context 5, 40 steps in batches of 8, one epoch of the reward model, augmentation
and the choice of the decision rule as by default; `ope` on 300 later rows; `recommend --k 3`. Hops
grow with the steps: each takes some.

The package that Python imports is traced; set PYTHONPATH to trace another checkout.
"""

import argparse
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, FrameType

import numpy as np
import pandas as pd

import ucfrec
from ucfrec.commands.cli import main as command
from ucfrec.reporting.tables import text_table

ROOT = Path(ucfrec.__file__).resolve().parents[1]
PACKAGES = ("ucfrec", "datasets", "simulators", "control")
SETTINGS = (
    *("train.steps=40", "train.batch_size=8", "train.validate_every=20"),
    *("policy.dim=16", "policy.context=5", "crm.epochs=1"),
)


class Tracer:
    """A profile function that records our files and the hops between them."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self.hops: Counter[tuple[str, str]] = Counter()
        """By (file of the caller, file of the callee)."""
        self._known: dict[CodeType, str] = {}

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        if event != "call" or not (file := self._file(frame.f_code)):
            return
        self.files.add(file)
        caller = frame.f_back
        while caller is not None and not self._file(caller.f_code):
            caller = caller.f_back
        if caller is not None and (origin := self._file(caller.f_code)) != file:
            self.hops[origin, file] += 1

    def _file(self, code: CodeType) -> str:
        """Our file that a function is of; empty for libraries and the bodies of modules."""
        if code not in self._known:
            path = Path(code.co_filename)
            ours = any(path.is_relative_to(ROOT / package) for package in PACKAGES)
            named = path.relative_to(ROOT).as_posix() if ours else ""
            self._known[code] = "" if code.co_name == "<module>" else named
        return self._known[code]


def traced(arguments: Sequence[str]) -> Tracer:
    """Run one `ucfrec` command in this process.

    Raises:
        SystemExit: it failed.
    """
    tracer = Tracer()
    threading.setprofile(tracer)
    sys.setprofile(tracer)
    try:
        status = command([*arguments])
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    if status:
        raise SystemExit(status)
    return tracer


def tiny_job(folder: Path) -> dict[str, Tracer]:
    """Trace `train`, `ope` and `recommend` on a small log in `folder`."""
    random, rows = np.random.default_rng(0), 2000
    log = pd.DataFrame(
        {
            "user_id": random.integers(0, 100, rows),
            "item_id": random.integers(0, 30, rows),
            "timestamp": 1_650_000_000_000 + 1000 * np.sort(random.integers(0, 10**7, rows)),
            "is_click": random.integers(0, 2, rows),
            "propensity": 1 / 30,
        }
    )
    log.to_parquet(folder / "log.parquet")
    later = log.tail(300).assign(timestamp=lambda table: table["timestamp"] + 10**10)
    later.to_parquet(folder / "later.parquet")
    at = {name: str(folder / name) for name in ("store", "run", "log.parquet", "later.parquet")}
    command(["prepare", at["log.parquet"], "--out", at["store"], "--reward", "is_click"])
    chosen = [word for setting in SETTINGS for word in ("--set", setting)]
    out = str(folder / "out.parquet")
    return {
        "train": traced(["train", at["store"], "--out", at["run"], *chosen]),
        "ope": traced(["ope", at["run"], at["later.parquet"]]),
        "recommend": traced(["recommend", at["run"], at["log.parquet"], "--k", "3", "--out", out]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--top", type=int, default=0, help="pairs of files to list (default: 0)")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="of ucfrec (default: tiny job)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        given = options.command
        found = {given[0]: traced(given)} if given else tiny_job(Path(folder))
    lines = [(name, len(t.files), f"{t.hops.total():,}", len(t.hops)) for name, t in found.items()]
    print(text_table(("command", "files", "hops", "pairs of files"), lines))
    for name, tracer in found.items():
        for (caller, callee), count in tracer.hops.most_common(options.top):
            print(f"{name}: {count:6,}  {caller} -> {callee}")


if __name__ == "__main__":
    main()
