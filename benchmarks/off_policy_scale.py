"""Wall time and peak memory of `ucfrec ope` on a million logged rows of 7,583 items.

    python benchmarks/off_policy_scale.py --folder scale          # 1 M rows, minutes
    python benchmarks/off_policy_scale.py --folder scale --rows 100000

Makes logs of a softmax policy over 7,583 items (the size of KuaiRand-Pure's catalogue) with
propensities, users in 16 groups of taste, item and user features, sessions of ten rows. The first
tenth of the rows is prepared and a small policy is trained on it for a few steps; a million later
ones are judged by `ucfrec ope`, which scores them, fits the models and draws the bootstrap. Each
command is a process of its own, with one thread. Appends a row a command to
runs/off_policy/results.jsonl, or to --results; FOLDER is kept, and what it has already is not made
again.
"""

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec.arrays import Float64Array, IntArray
from ucfrec.code_version import code_version
from ucfrec.errors import InputError
from ucfrec.progress import progress
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.schema import ITEM_ID, PROPENSITY, SESSION_ID, TIMESTAMP, USER_ID

RESULTS = Path("runs/off_policy/results.jsonl")
GROUPS, SESSION_ROWS, USER_SESSIONS, FEATURES = 16, 10, 2, 8
TRAINED_ON = 0.1
"""Share of the rows, on top of those that are judged."""
START_MS, SESSION_MS, STEP_MS = 1_704_067_200_000, 100, 1_000
SESSIONS_AT_ONCE = 20_000


@dataclass(frozen=True)
class Catalogue:
    """What users click, and what the logging policy shows, by group of users."""

    clicks: Float64Array
    """(GROUPS, n_items) probability of a click."""
    shown: Float64Array
    """(GROUPS, n_items) propensity."""
    items: Float64Array
    """(n_items, FEATURES)."""

    @classmethod
    def drawn(cls, n_items: int, seed: int) -> "Catalogue":
        """A catalogue whose logging policy knows tastes roughly."""
        rng = np.random.default_rng([seed, 61])
        items = rng.normal(size=(n_items, FEATURES))
        match = rng.normal(size=(GROUPS, FEATURES)) @ items.T / FEATURES**0.5
        guess = 0.5 * match + 0.5 * rng.normal(size=n_items)
        shown = np.exp(guess)
        return cls(1 / (1 + np.exp(1.5 - match)), shown / shown.sum(axis=1, keepdims=True), items)

    def write_logs(self, folder: Path, sessions: int, first: int, seed: int) -> None:
        """Write `sessions` sessions as Parquet, with `items.parquet` beside them.

        Args:
            first: number of the first session, which sets its time.
        """
        folder.mkdir(parents=True)
        names = {f"f{k}": column for k, column in enumerate(self.items.T)}
        pq.write_table(
            pa.table({ITEM_ID: np.arange(len(self.items)), **names}), folder / "items.parquet"
        )
        writer = None
        rng = np.random.default_rng([seed, 62, first])
        with progress(sessions, "write logs", "sessions") as bar:
            for begin in range(first, first + sessions, SESSIONS_AT_ONCE):
                numbers = np.arange(begin, min(begin + SESSIONS_AT_ONCE, first + sessions))
                table = self._sessions(numbers, rng)
                writer = writer or pq.ParquetWriter(folder / "sessions.parquet", table.schema)
                writer.write_table(table)
                bar.update(len(numbers))
        assert writer is not None
        writer.close()

    def _sessions(self, numbers: IntArray, rng: np.random.Generator) -> pa.Table:
        user = numbers // USER_SESSIONS
        group = np.repeat(user % GROUPS, SESSION_ROWS)
        item = np.empty(len(group), dtype=np.int64)
        for one in range(GROUPS):
            here = group == one
            upto = self.shown[one].cumsum()
            item[here] = np.searchsorted(upto, rng.random(here.sum()) * upto[-1])
        step = np.tile(np.arange(SESSION_ROWS), len(numbers))
        return pa.table(
            {
                USER_ID: np.repeat(user, SESSION_ROWS),
                SESSION_ID: np.repeat(numbers, SESSION_ROWS),
                TIMESTAMP: START_MS + np.repeat(numbers * SESSION_MS, SESSION_ROWS)
                + step * STEP_MS,
                ITEM_ID: item,
                "is_click": (rng.random(len(item)) < self.clicks[group, item]).astype(np.int8),
                PROPENSITY: self.shown[group, item],
            }
        )  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """What a command took."""

    wall_s: float
    cpu_s: float
    peak_mib: float


def measured(*arguments: str) -> Measured:
    """Run a `ucfrec` command in a process of one thread.

    Raises:
        InputError: it fails.
    """
    began = time.perf_counter()
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    command = [sys.executable, "-m", "ucfrec.commands.cli", *arguments]
    process = subprocess.Popen(command, env={**os.environ, **threads})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise InputError(f"ucfrec {arguments[0]} failed with status {process.returncode}")
    unit = 1 if sys.platform == "darwin" else 1024
    return Measured(
        time.perf_counter() - began,
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss * unit / 2**20,
    )


def made(folder: Path, rows: int, n_items: int) -> dict[str, Measured]:
    """Logs, store and run in `folder`, and what making each took, if it was made now."""
    found = {}
    catalogue, judged = Catalogue.drawn(n_items, seed=0), rows // SESSION_ROWS
    earlier = max(round(judged * TRAINED_ON), 1)
    for name, sessions, first in (("earlier", earlier, 0), ("later", judged, earlier)):
        if not (folder / name).exists():
            catalogue.write_logs(folder / name, sessions, first, seed=0)
    if not (folder / "store").exists():
        logs, store = str(folder / "earlier"), str(folder / "store")
        found["prepare"] = measured("prepare", logs, "--reward", "is_click", "--out", store)
    if not (folder / "run").exists():
        settings = ("train.steps=30", "policy.dim=32", "policy.context=5", "rule.choose=false")
        chosen = [word for one in settings for word in ("--set", one)]
        run = str(folder / "run")
        found["train"] = measured(
            "train", str(folder / "store"), "--out", run, "--policy", "dt", *chosen
        )
    return found


def row(command: str, one: Measured, rows: int, n_items: int) -> ResultRow:
    return ResultRow(
        suite="off-policy",
        table="scale",
        task=f"{rows:,} rows of {n_items:,} items",
        method=command,
        policy="dt",
        conditions={"rows": rows, "items": n_items, "threads": 1},
        code_version=code_version(Path(__file__), "ucfrec.off_policy.evaluate"),
        metric="wall_s",
        metrics={"wall_s": one.wall_s, "cpu_s": one.cpu_s, "peak_mib": one.peak_mib},
        wall_time_s=one.wall_s,
        peak_memory_mib=one.peak_mib,
        **provenance(),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True, help="for logs, store and run")
    parser.add_argument("--rows", type=int, default=1_000_000, help="to judge (default: 1000000)")
    parser.add_argument("--items", type=int, default=7583, help="of the catalogue (default: 7583)")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help=f"file of result rows (default: {RESULTS})"
    )
    options = parser.parse_args()
    folder = options.folder
    found = made(folder, options.rows, options.items)
    run, logs = str(folder / "run"), str(folder / "later")
    written = str(folder / "ope.json")
    found["ope"] = measured("ope", run, logs, "--temperature", "1", "--json", written)
    for name, one in found.items():
        print(f"{name:<8} {one.wall_s:7.0f} s wall {one.cpu_s:7.0f} s CPU {one.peak_mib:7.0f} MiB")
    rows = [row(name, one, options.rows, options.items) for name, one in found.items()]
    append_rows(options.results, rows)


if __name__ == "__main__":
    main()
