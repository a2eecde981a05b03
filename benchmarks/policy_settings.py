"""Which policy settings predict held-out actions best: the choice of λ and the weight of a_{t−1}.

    python benchmarks/policy_settings.py --store STORE... --out runs/settings

Trains UCF without copies on each store with each pair of settings and compares the validation
loss, never a simulator. Writes benchmarks/results/policy_settings.jsonl and prints a table.
"""

import argparse
import itertools
import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from ucfrec.episodes.store import EpisodeStore
from ucfrec.files import atomic_file
from ucfrec.provenance import provenance
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run

RESULTS = Path(__file__).parent / "results" / "policy_settings.jsonl"
DEMO_SIZE = ("policy.dim=64", "policy.context=10", "train.learning_rate=1e-3", "augment.copies=0")


def train(store: Path, out: Path, settings: dict[str, float], steps: int) -> dict[str, Any]:
    torch.set_num_threads(1)
    given = [f"{name}={value}" for name, value in settings.items()]
    config = resolve_config("ucf", None, [*DEMO_SIZE, f"train.steps={steps}", *given])
    name = "-".join(str(value) for value in settings.values())
    record = train_run(EpisodeStore.open(store), out / store.parent.name / name, config)
    loss = record["policy"]["best_validation"]
    keys = ("fingerprint", "seed", "wall_time_s")
    return {
        "store": store.parent.name,
        **settings,
        "validation_loss": loss,
        **{key: record[key] for key in keys},
        **provenance(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs; resumed")
    parser.add_argument("--lambda-mask", type=float, nargs="+", default=[0, 0.01, 0.03, 0.1])
    parser.add_argument("--parent-action", type=float, nargs="+", default=[0, 0.3])
    parser.add_argument("--steps", type=int, default=1000)
    options = parser.parse_args()
    pairs = [
        {"policy.lambda_mask": weight, "policy.parent_action": action}
        for weight, action in itertools.product(options.lambda_mask, options.parent_action)
    ]
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        jobs = [
            pool.submit(train, store, options.out, pair, options.steps)
            for store in options.store
            for pair in pairs
        ]
        rows = [job.result() for job in jobs]
    with atomic_file(RESULTS) as scratch:
        scratch.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("| store | λ | weight of a_{t−1} | validation loss |")
    print("|---|---|---|---|")
    for row in rows:
        weight, action = row["policy.lambda_mask"], row["policy.parent_action"]
        print(f"| {row['store']} | {weight} | {action} | {row['validation_loss']:.4f} |")


if __name__ == "__main__":
    main()
