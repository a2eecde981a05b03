"""Kill, interrupt, pair, flip, fuzz and starve the commands; print one table.

python -m tests.torture --scale 0.05 --only fuzz
python -m tests.torture --scale 0.05 --mutants

Exits with 1 if a case has a fault. With --mutants, each part of a check that a mutant of ucfrec
breaks runs on it, and must have a fault."""

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
from tests.torture.mutants import MUTANTS, applied
from tests.torture.readers import Reader, list_readers, read_run, read_store

FULL = {"kills": 800, "interruptions": 200, "pairs": 80, "flips": 1000, "fuzz": 100_000}
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
    parser.add_argument("--mutants", action="store_true", help="run on mutants, all to be found")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scratch", type=Path, help="folder for files (default: memory, if any)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    memory = Path("/dev/shm")
    scratch = options.scratch or (memory if os.access(memory, os.W_OK) else None)
    cases = {check: options.scale * FULL[check] for check in options.only or FULL}
    failed = 0
    with tempfile.TemporaryDirectory(prefix="torture-", dir=scratch) as name:
        folder = Path(name)
        use_temporary(folder)
        print(f"{'check':<16}{'part':<41}{'seconds':>7}  counts", flush=True)
        for check, part, count in list_parts(folder, cases, options.mutants, options.seed):
            mutant = MUTANTS[check, part] if options.mutants else None
            start = time.monotonic()
            with applied(mutant):
                counts = +count()
            seconds = time.monotonic() - start
            faults = [(n, number) for n, number in counts.most_common() if n not in NO_FAULTS]
            harmless = ", ".join(f"{counts[n]:,} {n}" for n in NO_FAULTS if counts[n])
            print(f"{check:<16}{part:<42}{seconds:>6.0f}  {harmless}", flush=True)
            for fault, number in faults[: 1 if mutant else None]:
                print(f"    {number} × {fault}", flush=True)
            if mutant and not faults:
                print(f"    not found: ucfrec without {mutant[0]}", flush=True)
            failed += not faults if mutant else sum(number for _, number in faults)
    print(f"{failed} {'mutants not found' if options.mutants else 'faults'}")
    return int(failed > 0)


def list_parts(folder: Path, cases: dict[str, float], mutated: bool, seed: int) -> Iterator[Part]:
    """The parts of checks in `cases`, of a case at least; if `mutated`, what a mutant breaks."""
    inputs = Inputs(folder)
    jobs, readers = inputs.jobs(), list_readers(inputs)
    ends = cache(partial(Ends.of, inputs, folder))
    store = Reader("store", inputs.store, "meta.json", read_store)
    run = Reader("run", inputs.single_run, "run.json", read_run)

    def wanted(check: str, part: str) -> bool:
        return check in cases and (not mutated or (check, part) in MUTANTS)

    def share(check: str, part: int, whole: int) -> int:
        least = {"fuzz": 30}.get(check, 6) if mutated else 1
        return max(least, round(cases[check] * part / whole))

    for check in ("kills", "interruptions", "pairs"):
        for job in jobs:
            if wanted(check, job.name):
                count = getattr(ends(job), check)
                yield check, job.name, partial(count, share(check, 1, len(jobs)), seed)
    for reader in (store, run):
        if wanted("flips", reader.name):
            yield "flips", reader.name, partial(reader.flip, folder, share("flips", 1, 2), seed)
    weights = {reader.name: 1 if reader.slow else 10 for reader in readers}
    for reader in readers:
        if wanted("fuzz", reader.name):
            number = share("fuzz", weights[reader.name], sum(weights.values()))
            yield "fuzz", reader.name, partial(reader.fuzz, folder, number, seed)
    for job in jobs:
        if wanted("limits", job.name):
            yield "limits", job.name, partial(limits.limits, inputs, job, folder)
    if wanted("hostile Parquet", "prepare"):
        yield "hostile Parquet", "prepare", partial(limits.hostile_parquet, folder)


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    # DuckDB would report its own leaks.
    os._exit(status)
