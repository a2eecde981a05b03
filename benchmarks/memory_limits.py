"""Memory of `prepare`, `train`, `score`, `ope` and `recommend` on stores larger than a limit.

    python benchmarks/memory_limits.py --folder limits            # 10 GB of disk

Makes two logs and prepares them: one of very many rows of items (the log of prepare_time.py), and
one of rows with long observations. Then every command runs as a process of its own, of one thread,
and its memory is watched: what the system calls anonymous, which it cannot give back as it can
pages of mapped files. With --cgroup the system holds each to the limit, such pages and what it
keeps of files included. A few training steps will do: what grows with a store grows before the
first one. Scoring takes time a row, so the long log is trained on and the wide one evaluated too.
Appends a row a command to runs/memory_limits/results.jsonl, or to --results; FOLDER is kept, and
logs and stores that it has are not made again.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measured_rows import append_row, make_parser
from prepare_time import make_log

from ucfrec.logs.engine import anonymous_bytes, bytes_of
from ucfrec.reporting.tables import markdown_table

SUITE = "memory-limits"
OBSERVATION = 1024
"""Numbers of an observation in the wide log."""
ITEMS, ROWS_PER_USER, BATCH = 500, 20, 20_000
START_MS = 1_700_000_000_000
SMALL = (
    *("train.steps=30", "train.validate_every=30", "policy.dim=32", "policy.context=5"),
    "rule.choose=false",
)
SECONDS = 0.02
"""Between two looks at the memory of a process."""


def make_wide_log(folder: Path, rows: int, seed: int) -> None:
    """Write a log of users in turn, each row with an observation and a propensity."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    folder.mkdir(parents=True)
    generator = np.random.default_rng(seed)
    writer: pq.ParquetWriter | None = None
    for begin in range(0, rows, BATCH):
        n = min(BATCH, rows - begin)
        numbers = generator.normal(size=n * OBSERVATION).astype(np.float32)
        row = np.arange(begin, begin + n)
        table = pa.table(
            {
                "user_id": row // ROWS_PER_USER,
                "item_id": generator.integers(ITEMS, size=n),
                "timestamp": START_MS + row * 1000,
                "is_click": (generator.random(n) < 0.2).astype(np.int8),
                "propensity": np.full(n, 1 / ITEMS, dtype=np.float32),
                "observation": pa.FixedSizeListArray.from_arrays(pa.array(numbers), OBSERVATION),
            }
        )
        lists = table["observation"].cast(pa.list_(pa.float32()))
        table = table.set_column(5, "observation", lists)
        writer = writer or pq.ParquetWriter(folder / "log.parquet", table.schema)
        writer.write_table(table)
    assert writer is not None
    writer.close()


class Measured(NamedTuple):
    """What a command took."""

    wall_s: float
    anonymous_mib: float
    """Most memory that is not mapped from files, seen in looks at short intervals."""
    resident_mib: float
    """Most memory, pages of mapped files among it."""


@contextmanager
def limited_group(parent: Path | None, limit: int) -> Iterator[Path | None]:
    """A control group whose processes are killed beyond the limit (bytes); None without parent."""
    if parent is None:
        yield None
        return
    group = parent / f"ucfrec-{os.getpid()}"
    group.mkdir()
    try:
        unified = (parent / "cgroup.controllers").exists()
        (group / ("memory.max" if unified else "memory.limit_in_bytes")).write_text(str(limit))
        yield group
    finally:
        group.rmdir()


def measured(arguments: list[str], group: Path | None) -> Measured:
    """Run a `ucfrec` command, in a control group if one is given.

    Raises:
        SystemExit: it fails.
    """
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "ucfrec", *arguments],
        env={**os.environ, **threads},
        stdout=subprocess.DEVNULL,
        preexec_fn=None
        if group is None
        else lambda: (group / "cgroup.procs").write_text(str(os.getpid())),
    )
    most = 0
    while True:
        most = max(most, anonymous_bytes(process.pid))
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
        if ended:
            break
        time.sleep(SECONDS)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"ucfrec {arguments[0]} failed")
    return Measured(time.perf_counter() - began, most / 2**20, usage.ru_maxrss / 1024)


def size_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def commands(folder: Path, kind: str, limit: int) -> dict[str, list[str]]:
    """Command to its arguments, for the log called `kind`."""
    log, store, run = (str(folder / f"{kind}-{part}") for part in ("log", "store", "run"))
    settings = [word for one in SMALL for word in ("--set", one)]
    within = ["--memory-limit", f"{limit} B"]
    found = {
        "prepare": ["prepare", log, "--reward", "is_click", "--out", store, *within],
        "train": ["train", store, "--out", run, "--threads", "1", *settings],
    }
    if kind == "wide":
        written = str(folder / "wide-scores.parquet")
        found |= {
            "score": ["score", run, log, "--out", written, *within],
            "ope": ["ope", run, log, "--temperature", "1", *within],
            "recommend": ["recommend", run, log, "--out", str(folder / "top.parquet"), *within],
        }
    return found


def main() -> None:
    parser = make_parser(__doc__, SUITE)
    parser.add_argument("--folder", type=Path, required=True, help="for logs, stores and runs")
    parser.add_argument("--limit", default="1GB", help="of a command's memory (default: 1GB)")
    parser.add_argument(
        "--long", type=int, default=80_000_000, help="rows; 0: none (default: 80000000)"
    )
    parser.add_argument("--wide", type=int, default=300_000, help="rows; 0: none (default: 300000)")
    parser.add_argument(
        "--cgroup",
        type=Path,
        metavar="FOLDER",
        help="control group of the memory controller; commands run in one of their own in it, with "
        "the limit, beyond which the system kills them (default: none, memory is only watched)",
    )
    parser.add_argument("--commands", nargs="+", default=[], help="no others (default: all)")
    options = parser.parse_args()
    folder, limit = options.folder, bytes_of(options.limit)
    assert limit is not None
    folder.mkdir(parents=True, exist_ok=True)
    lines, grouped = [], {} if options.cgroup is None else {"control group": True}
    for kind, rows, make in (
        ("long", options.long, make_log),
        ("wide", options.wide, make_wide_log),
    ):
        if not rows:
            continue
        if not (folder / f"{kind}-log").exists():
            make(folder / f"{kind}-log", rows, 0)
        for command, arguments in commands(folder, kind, limit).items():
            if options.commands and command not in options.commands:
                continue
            if command == "prepare" and (folder / f"{kind}-store").exists():
                continue
            with limited_group(options.cgroup, limit) as group:
                one = measured(arguments, group)
            store = size_of(folder / f"{kind}-store") / 2**20
            metrics = {
                "anonymous_mib": one.anonymous_mib,
                "within": float(one.anonymous_mib * 2**20 <= limit),
                "resident_mib": one.resident_mib,
                "store_mib": store,
                "log_mib": size_of(folder / f"{kind}-log") / 2**20,
                "limit_mib": limit / 2**20,
            }
            about = {
                "conditions": {"rows": rows, "limit": options.limit, "threads": 1, **grouped},
                "wall_time_s": one.wall_s,
                "peak_memory_mib": one.resident_mib,
            }
            task = f"{kind} log, {rows:,} rows"
            append_row(options.results, SUITE, task, command, metrics, policy="ucf", **about)
            cells = (f"{store:,.0f}", f"{one.anonymous_mib:,.0f}", f"{one.resident_mib:,.0f}")
            lines.append((kind, f"{rows:,}", command, *cells, f"{one.wall_s:.0f}"))
    head = ("log", "rows", "command", "store MiB", "anonymous MiB", "resident MiB")
    print(markdown_table((*head, "wall s"), lines))


if __name__ == "__main__":
    main()
