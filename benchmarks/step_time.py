"""CPU time of a training step of every policy on one thread, as a ratio to those of DT and DC.

    python benchmarks/step_time.py --dim 128 --context 20

Appends the rows to runs/step_time/results.jsonl, or to --results, and prints a table. Only ratios
are kept: the policies are timed in turn, so a slower machine slows all of them. A step of our DC
takes 0.86 of one of its authors' code.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from ucfrec.code_version import code_version
from ucfrec.episodes.windows import Windows
from ucfrec.fitting.row_optimizer import RowAdamW
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import resolve_config

RESULTS = Path("runs/step_time/results.jsonl")
SIZES = {"state": 91, "action": 27, "items": 0}
LEARNERS = ("dt", "dc", "lsdt", "ucf", "dt4rec", "cdt4rec", "edt4rec", "sasrec", "bc")


def windows(batch: int, context: int) -> Windows:
    """Random windows of (batch, context) steps."""
    return Windows(
        states=torch.randn(batch, context, SIZES["state"]),
        actions=torch.rand(batch, context, SIZES["action"]) * 2 - 1,
        rewards=torch.rand(batch, context),
        returns_to_go=torch.rand(batch, context),
        timesteps=torch.arange(context).repeat(batch, 1),
        mask=torch.ones(batch, context, dtype=torch.bool),
    )


def step_seconds(policy: SequencePolicy, optimizer: torch.optim.Optimizer, batch: Windows) -> float:
    """CPU seconds of one training step."""
    began = time.thread_time()
    value, _ = policy.loss(batch)
    optimizer.zero_grad()
    value.backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    return time.thread_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dim", type=int, default=128, help="width of the policies (default: 128)")
    parser.add_argument("--context", type=int, default=20, help="steps of a window (default: 20)")
    parser.add_argument("--batch", type=int, default=64, help="windows of a batch (default: 64)")
    parser.add_argument("--rounds", type=int, default=20, help="timed rounds (default: 20)")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help=f"file of result rows (default: {RESULTS})"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    batch = windows(options.batch, options.context)
    learners = {}
    for name in LEARNERS:
        settings = [f"policy.dim={options.dim}", f"policy.context={options.context}"]
        policy = policy_class(name)(resolve_config(name, None, settings).policy, SIZES)
        learners[name] = policy, RowAdamW(policy.parameters(), fused=True)
    seconds: dict[str, list[float]] = {name: [] for name in learners}
    for turn in range(options.rounds + 2):
        for name, (policy, optimizer) in learners.items():
            taken = step_seconds(policy, optimizer, batch)
            if turn >= 2:
                seconds[name].append(taken)
    sizes = {name: getattr(options, name) for name in ("dim", "context", "batch", "rounds")}
    lines = []
    for name in learners:
        low, middle, high = np.quantile(np.divide(seconds[name], seconds["dt"]), [0.1, 0.5, 0.9])
        of_dc = float(np.median(np.divide(seconds[name], seconds["dc"])))
        lines.append((name, f"{middle:.2f} [{low:.2f}, {high:.2f}]", f"{of_dc:.3f}"))
        row = ResultRow(
            suite="step-time",
            table="step-time",
            task="random windows",
            method=name,
            policy=name,
            conditions=sizes,
            code_version=code_version(Path(__file__), policy_class(name).__module__),
            metric="ratio",
            metrics={"ratio": middle, "ratio_10": low, "ratio_90": high, "ratio_to_dc": of_dc},
            wall_time_s=sum(seconds[name]),
            **provenance(),
        )
        append_rows(options.results, [row])
    print(markdown_table(("policy", "time of a step / DT's, median [10%, 90%]", "/ DC's"), lines))


if __name__ == "__main__":
    main()
