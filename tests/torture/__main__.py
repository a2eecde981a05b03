"""Kill, interrupt, pair, flip, fuzz and starve the commands; print one table.

python -m tests.torture --scale 0.01 --results rows.jsonl

Every check has parts (a command, a reader), each with a row of its own, which is written as soon as
it is measured. A part that the file of rows has, of the same size, is measured again only with
--again.
"""

import argparse
import gc
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

from tests.torture import damage, fuzz, limits
from tests.torture.ends import Ends
from tests.torture.made import Inputs, temporary
from ucfrec.provenance import provenance
from ucfrec.results.row import ResultRow, RowKey
from ucfrec.results.rows_file import append_rows, read_rows, remove_rows

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
COUNTED = (
    *("killed", "interrupted", "refused", "found", "harmless", "skipped"),
    "ended by a library",
)
"""Entries of a check that are no faults."""


@dataclass(frozen=True)
class Part:
    """One row: the cases of a check that concern one command or one reader."""

    check: str
    name: str
    cases: int
    run: Callable[[], Counter[str]]
    """Counts by `COUNTED`, and `cases` if they turn out to differ; other entries are faults."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the cases (default: 1)")
    parser.add_argument("--only", action="append", default=[], choices=[*FULL])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, help="file of result rows to append to")
    parser.add_argument("--again", action="store_true", help="measure all parts, with a row or not")
    parser.add_argument("--scratch", type=Path, help="folder for files (default: memory, if any)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    measured = read_rows(options.results) if options.results and not options.again else []
    shared = Path("/dev/shm")
    scratch = options.scratch or (shared if os.access(shared, os.W_OK) else None)
    total = Counter[str]()
    with tempfile.TemporaryDirectory(prefix="torture-", dir=scratch) as name:
        folder = Path(name)
        temporary(folder)
        inputs = Inputs(folder)
        print(
            f"{'check':<16}{'part':<26}{'cases':>8}{'faults':>7}{'seconds':>8}  counts", flush=True
        )
        for part in _parts(inputs, folder, options):
            key = _key(part, options.seed)
            row = next((row for row in measured if key.covers(row)), None)
            if row is None:
                row, faults = _measured(part, key)
                if options.results is not None:
                    remove_rows(options.results, [key])
                    append_rows(options.results, [row])
            else:
                faults = row.details
            _show(row, faults)
            total.update({name: int(n) for name, n in row.metrics.items()})
    print(", ".join(f"{n:,} {name}" for name, n in total.items()))
    return int(bool(total["faults"]))


def _parts(inputs: Inputs, folder: Path, options: argparse.Namespace) -> Iterator[Part]:
    cases = {
        check: max(1, round(number * options.scale))
        for check, number in FULL.items()
        if not options.only or check in options.only
    }
    seed, jobs = options.seed, inputs.jobs()

    @cache
    def ends(number: int) -> Ends:
        return Ends.of(inputs, jobs[number], folder)

    for check in ("kills", "interruptions", "pairs"):
        for number, job in enumerate(jobs):
            share = _share(cases.get(check, 0), len(jobs), number)
            if share:
                work = getattr(ends(number), check)
                yield Part(check, job.name, share, lambda w=work, n=share: w(n, seed))
    for number, source in enumerate((inputs.store, inputs.run)):
        if share := _share(cases.get("flips", 0), 2, number):
            yield Part(
                *("flips", source.name, share),
                lambda s=source, n=share: damage.flips(inputs, s, folder, n, seed),
            )
    for reader, share in fuzz.shares(cases.get("fuzz", 0), inputs).items():
        yield Part(
            *("fuzz", reader, share),
            lambda r=reader, n=share: fuzz.fuzz(inputs, r, folder, n, seed),
        )
    if "limits" in cases:
        yield Part("limits", "every command", 1, lambda: limits.limits(inputs, folder))
    if "hostile Parquet" in cases:
        yield Part("hostile Parquet", "prepare", 1, lambda: limits.hostile_parquet(folder))


def _share(cases: int, parts: int, number: int) -> int:
    return cases // parts + (number < cases % parts)


def _measured(part: Part, key: RowKey) -> tuple[ResultRow, dict[str, int]]:
    gc.collect()
    gc.freeze()
    start = time.monotonic()
    counts = +part.run()
    seconds = time.monotonic() - start
    cases = counts.pop("cases", part.cases)
    faults = {name: n for name, n in counts.items() if name not in COUNTED}
    numbers = {name: float(n) for name, n in counts.items() if name in COUNTED}
    total = float(sum(faults.values()))
    row = ResultRow(
        **{name: getattr(key, name) for name in RowKey.__dataclass_fields__},
        metric="faults",
        metrics={"faults": total, "cases": float(cases), **numbers},
        details=faults,
        wall_time_s=round(seconds, 1),
        **provenance(),
    )
    return row, faults


def _key(part: Part, seed: int) -> RowKey:
    return RowKey(
        suite="torture",
        table="torture",
        task=part.check,
        method=part.name,
        policy="none",
        evaluation_seed=seed,
        conditions={"cases": part.cases},
    )


def _show(row: ResultRow, faults: object) -> None:
    numbers = dict(row.metrics)
    cases, total = int(numbers.pop("cases")), int(numbers.pop("faults"))
    about = ", ".join(f"{int(n):,} {name}" for name, n in numbers.items())
    print(
        f"{row.task:<16}{row.method:<26}{cases:>8,}{total:>7,}{row.wall_time_s:>8.0f}  {about}",
        flush=True,
    )
    ordered = sorted(faults.items(), key=lambda each: -each[1]) if isinstance(faults, dict) else []
    for fault, n in ordered[:40]:
        print(f"    {n} × {fault}", flush=True)


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    # DuckDB would report its own leaks.
    os._exit(status)
