"""Kill, interrupt, pair, flip, fuzz and starve the commands; print one table.

python -m tests.torture --scale 0.01 --results rows.jsonl
"""

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

from tests.torture import damage, ends, fuzz, limits
from tests.torture.made import Inputs, temporary
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows

FULL = {
    "kills": 500,
    "interruptions": 200,
    "pairs": 80,
    "flips": 1000,
    "fuzz": 100_000,
    "limits": 1,
    "hostile Parquet": 1,
}
"""Number of cases of each check at scale 1."""
COUNTED = ("killed", "interrupted", "refused", "found", "harmless", "skipped", "cases")
"""Entries of a check that are no faults."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the cases (default: 1)")
    parser.add_argument("--only", action="append", default=[], choices=[*FULL])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, help="file of result rows to append to")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows, failed = [], False
    with tempfile.TemporaryDirectory(prefix="torture-") as name:
        folder = Path(name)
        temporary(folder)
        inputs = Inputs(folder)
        known = ends.references(inputs, folder)
        checks: dict[str, Callable[[int], Counter[str]]] = {
            "kills": lambda n: ends.kills(inputs, known, folder, n, options.seed),
            "interruptions": lambda n: ends.interruptions(inputs, known, folder, n, options.seed),
            "pairs": lambda n: ends.pairs(inputs, known, folder, n, options.seed),
            "flips": lambda n: damage.flips(inputs, folder, n, options.seed),
            "fuzz": lambda n: fuzz.fuzz(inputs, folder, n, options.seed),
            "limits": lambda n: limits.limits(inputs, folder),
            "hostile Parquet": lambda n: limits.hostile_parquet(folder),
        }
        print(f"{'check':<18}{'cases':>8}{'faults':>8}{'seconds':>9}  counts", flush=True)
        for check, cases in FULL.items():
            if options.only and check not in options.only:
                continue
            scaled = max(1, round(cases * options.scale))
            start = time.monotonic()
            counts = +checks[check](scaled)
            seconds = time.monotonic() - start
            faults = {name: n for name, n in counts.items() if name not in COUNTED}
            done = counts.get("cases", scaled)
            about = ", ".join(f"{n} {name}" for name, n in counts.items() if name in COUNTED[:-1])
            total = sum(faults.values())
            print(f"{check:<18}{done:>8,}{total:>8,}{seconds:>9.0f}  {about}", flush=True)
            for fault, n in sorted(faults.items(), key=lambda each: -each[1])[:40]:
                print(f"    {n} × {fault}", flush=True)
            failed |= bool(total)
            rows.append(_row(check, done, total, seconds, counts, options.seed))
    if options.results is not None:
        append_rows(options.results, rows)
    return int(failed)


def _row(
    check: str, cases: int, faults: int, seconds: float, counts: Counter[str], seed: int
) -> ResultRow:
    numbers = {name: float(n) for name, n in counts.items() if name in COUNTED[:-1]}
    return ResultRow(
        suite="torture",
        table="torture",
        task=check,
        method="ucfrec",
        policy="none",
        evaluation_seed=seed,
        metric="faults",
        metrics={"faults": float(faults), "cases": float(cases), **numbers},
        wall_time_s=round(seconds, 1),
        **provenance(),
    )


if __name__ == "__main__":
    sys.exit(main())
