"""Cost of checksums: opening a store, and `ucfrec verify` against reading the same files once.

    python benchmarks/checksum_cost.py --steps 20000000

Makes a store of random steps in a scratch folder, which is removed at the end. Verifying and a
plain loop that reads the files into a buffer take turns, both from the page cache. Appends the rows
to runs/checksum_cost/results.jsonl, or to --results, and prints a table.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from ucfrec.code_version import code_version
from ucfrec.episodes.record import StoreRecord
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.locks import scratch_folder
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table

RESULTS = Path("runs/checksum_cost/results.jsonl")
LENGTH = 20
"""Steps of an episode."""
BLOCK = 2**20
"""Bytes that the plain loop reads at a time."""


def make_store(path: Path, steps: int, seed: int) -> None:
    """Write a store of random steps, with the columns that a log of impressions has."""
    generator = np.random.default_rng(seed)
    columns = {
        "item": generator.integers(0, 10_000, steps, dtype=np.int32),
        "reward": generator.random(steps, dtype=np.float32),
        "timestamp": np.arange(steps) + 1_700_000_000_000,
        "propensity": generator.random(steps, dtype=np.float32),
    }
    EpisodeStore.write(path, columns, np.full(steps // LENGTH, LENGTH))


def open_seconds(path: Path) -> float:
    """Wall seconds of opening a store."""
    began = time.perf_counter()
    EpisodeStore.open(path)
    return time.perf_counter() - began


def read_seconds(path: Path) -> float:
    """Wall seconds of reading every sealed file into one buffer."""
    sealed = StoreRecord.read(path).checksums(path)
    buffer = bytearray(BLOCK)
    began = time.perf_counter()
    for name in sealed.files:
        with (path / name).open("rb", buffering=0) as file:
            while file.readinto(buffer):
                pass
    return time.perf_counter() - began


def verify_seconds(path: Path) -> float:
    """Wall seconds of comparing every sealed file with its checksum."""
    sealed = StoreRecord.read(path).checksums(path)
    began = time.perf_counter()
    assert not list(sealed.faults())
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000_000, help="(default: 20 million)")
    parser.add_argument("--rounds", type=int, default=9, help="timed rounds (default: 9)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path(), help="of the scratch (default: .)")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help=f"file of result rows (default: {RESULTS})"
    )
    options = parser.parse_args()
    taken: dict[str, list[float]] = {"open": [], "read": [], "verify": []}
    began = time.perf_counter()
    with scratch_folder(options.folder, "checksum-cost") as folder:
        path = folder / "store"
        make_store(path, options.steps // LENGTH * LENGTH, options.seed)
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        for turn in range(options.rounds + 1):
            for name, seconds in zip(
                taken, (open_seconds(path), read_seconds(path), verify_seconds(path)), strict=True
            ):
                if turn:  # the first fills the page cache
                    taken[name].append(seconds)
    ratios = np.divide(taken["verify"], taken["read"])
    measured = {
        "open_ms": np.multiply(taken["open"], 1e3),
        "read_s": np.array(taken["read"]),
        "verify_s": np.array(taken["verify"]),
        "verify_to_read": ratios,
    }
    lines, metrics = [], {"bytes": float(size)}
    for name, values in measured.items():
        low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
        metrics |= {name: middle, f"{name}_10": low, f"{name}_90": high}
        lines.append((name, f"{middle:.3g} [{low:.3g}, {high:.3g}]"))
    row = ResultRow(
        suite="checksum-cost",
        table="checksum-cost",
        task="random steps",
        method="XXH3, two threads",
        policy="none",
        conditions={"steps": options.steps, "rounds": options.rounds},
        code_version=code_version(
            Path(__file__), "ucfrec.files.checksums", "ucfrec.episodes.store"
        ),
        metric="verify_to_read",
        metrics=metrics,
        wall_time_s=time.perf_counter() - began,
        **provenance(),
    )
    append_rows(options.results, [row])
    print(f"{options.steps:,} steps, {size / 1e6:,.0f} MB, {options.rounds} rounds\n")
    print(markdown_table(("cost", "median [10%, 90%]"), lines))


if __name__ == "__main__":
    main()
