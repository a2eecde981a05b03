"""The demo over several seeds: mean and spread of every policy.

    python benchmarks/demo_seeds.py --out runs/demos --seeds 0 1 2

Writes the raw rows to benchmarks/results/demo.jsonl and prints a table.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from ucfrec.commands.demo import LEARNERS, WORLDS, DemoConfig, demo
from ucfrec.files import atomic_file

RESULTS = Path(__file__).parent / "results" / "demo.jsonl"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs; resumed")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    rows = []
    for seed in options.seeds:
        rows += demo(options.out / f"seed-{seed}", seed, DemoConfig())
    with atomic_file(RESULTS) as scratch:
        scratch.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("| world | policy | R_cum, mean ± sd over seeds | each seed |")
    print("|---|---|---|---|")
    for world in WORLDS:
        for policy in ("random", "logging", *LEARNERS, "optimal"):
            earned = [r["R_cum"] for r in rows if (r["world"], r["policy"]) == (world, policy)]
            each = ", ".join(f"{value:.2f}" for value in earned)
            spread = np.std(earned, ddof=1) if len(earned) > 1 else 0.0
            print(f"| {world} | {policy} | {np.mean(earned):.2f} ± {spread:.2f} | {each} |")


if __name__ == "__main__":
    main()
