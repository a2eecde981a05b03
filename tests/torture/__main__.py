"""Kill, interrupt, pair, flip, fuzz and starve the commands; print one table.

python -m tests.torture --scale 0.01 --only fuzz

Exits with 1 if a case has a fault. Every check has parts: a command, or a reader of files.
"""

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

from tests.torture import limits
from tests.torture.ends import Ends
from tests.torture.inputs import Inputs, use_temporary
from tests.torture.readers import (
    Reader,
    flip_bits,
    fuzz,
    list_readers,
    read_run,
    read_store,
    share_cases,
)

FULL = {"kills": 500, "interruptions": 200, "pairs": 80, "flips": 1000, "fuzz": 100_000}
FULL |= {"limits": 1, "hostile Parquet": 1}
"""Number of cases of each check at scale 1."""
NO_FAULTS = ("killed", "interrupted", "refused", "found", "harmless", "skipped", "cases")
NO_FAULTS += ("ended by a library",)
"""Counts of a check that are no faults."""
Part = tuple[str, str, Callable[[], Counter[str]]]
"""Check, name of the command or reader, and what counts its cases."""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scale", type=float, default=1.0, help="share of the cases (default: 1)")
    parser.add_argument("--only", action="append", default=[], choices=[*FULL])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scratch", type=Path, help="folder for files (default: memory, if any)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    memory = Path("/dev/shm")
    scratch = options.scratch or (memory if os.access(memory, os.W_OK) else None)
    cases = {
        check: max(1, round(number * options.scale))
        for check, number in FULL.items()
        if not options.only or check in options.only
    }
    faults = 0
    with tempfile.TemporaryDirectory(prefix="torture-", dir=scratch) as name:
        folder = Path(name)
        use_temporary(folder)
        inputs = Inputs(folder)
        print(f"{'check':<16}{'part':<32}{'seconds':>8}  counts", flush=True)
        for check, part, count in list_parts(inputs, folder, cases, options.seed):
            start = time.monotonic()
            counts = +count()
            seconds = time.monotonic() - start
            harmless = ", ".join(f"{counts[n]:,} {n}" for n in NO_FAULTS if counts[n])
            print(f"{check:<16}{part:<32}{seconds:>8.0f}  {harmless}", flush=True)
            for fault, number in counts.most_common():
                if fault not in NO_FAULTS:
                    print(f"    {number} × {fault}", flush=True)
                    faults += number
    print(f"{faults} faults")
    return int(faults > 0)


def list_parts(inputs: Inputs, folder: Path, cases: dict[str, int], seed: int) -> Iterator[Part]:
    jobs = inputs.jobs()

    @cache
    def ends(number: int) -> Ends:
        return Ends.of(inputs, jobs[number], folder)

    for check in ("kills", "interruptions", "pairs"):
        for number, job in enumerate(jobs):
            if share := share_evenly(cases.get(check, 0), len(jobs), number):
                yield check, job.name, partial(getattr(ends(number), check), share, seed)
    store = Reader("store", inputs.store, "meta.json", read_store)
    run = Reader("run", inputs.single_run, "run.json", read_run)
    for number, reader in enumerate((store, run)):
        if share := share_evenly(cases.get("flips", 0), 2, number):
            yield "flips", reader.name, partial(flip_bits, reader, folder, share, seed)
    if "fuzz" in cases:
        readers = list_readers(inputs)
        shares = share_cases(cases["fuzz"], readers)
        for reader in readers:
            yield "fuzz", reader.name, partial(fuzz, reader, folder, shares[reader.name], seed)
    if "limits" in cases:
        yield "limits", "every command", partial(limits.limits, inputs, folder)
    if "hostile Parquet" in cases:
        yield "hostile Parquet", "prepare", partial(limits.hostile_parquet, folder)


def share_evenly(cases: int, parts: int, number: int) -> int:
    return cases // parts + (number < cases % parts)


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    # DuckDB would report its own leaks.
    os._exit(status)
