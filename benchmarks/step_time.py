"""A training step of every sequence policy, timed in turn on one thread, as ratios to DT's.

    python benchmarks/step_time.py --dim 128 --context 20

Writes benchmarks/results/step_time.jsonl and prints a table. Only ratios are kept: the policies
take turns, so a machine that slows down slows all of them.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from ucfrec.episodes.windows import Windows
from ucfrec.files import atomic_file
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import provenance
from ucfrec.runs.config import resolve_config

RESULTS = Path(__file__).parent / "results" / "step_time.jsonl"
SIZES = {"state": 91, "action": 27, "items": 0}
LEARNERS = ("dt", "dc", "lsdt", "ucf", "dt4rec", "cdt4rec", "edt4rec", "sasrec", "bc")


def windows(batch: int, context: int) -> Windows:
    return Windows(
        states=torch.randn(batch, context, SIZES["state"]),
        actions=torch.rand(batch, context, SIZES["action"]) * 2 - 1,
        rewards=torch.rand(batch, context),
        returns_to_go=torch.rand(batch, context),
        timesteps=torch.arange(context).repeat(batch, 1),
        mask=torch.ones(batch, context, dtype=torch.bool),
    )


def step_seconds(policy: SequencePolicy, optimizer: torch.optim.Optimizer, batch: Windows) -> float:
    began = time.perf_counter()
    value, _ = policy.loss(batch)
    optimizer.zero_grad()
    value.backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dim", type=int, default=128)
    parser.add_argument("--context", type=int, default=20)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    batch = windows(options.batch, options.context)
    learners = {}
    for name in LEARNERS:
        settings = [f"policy.dim={options.dim}", f"policy.context={options.context}"]
        policy = policy_class(name)(resolve_config(name, None, settings).policy, SIZES)
        learners[name] = policy, torch.optim.AdamW(policy.parameters(), fused=True)
    seconds: dict[str, list[float]] = {name: [] for name in learners}
    for turn in range(options.rounds + 2):
        for name, (policy, optimizer) in learners.items():
            taken = step_seconds(policy, optimizer, batch)
            if turn >= 2:
                seconds[name].append(taken)
    rows = []
    print("| policy | time of a step / DT's, median [10%, 90%] |")
    print("|---|---|")
    for name in learners:
        low, middle, high = np.quantile(np.divide(seconds[name], seconds["dt"]), [0.1, 0.5, 0.9])
        print(f"| {name} | {middle:.2f} [{low:.2f}, {high:.2f}] |")
        row = {"policy": name, "ratio": middle, "ratio_low": low, "ratio_high": high}
        rows.append({**row, **vars(options), **provenance()})
    with atomic_file(RESULTS) as scratch:
        scratch.write_text("".join(json.dumps(row) + "\n" for row in rows))


if __name__ == "__main__":
    main()
