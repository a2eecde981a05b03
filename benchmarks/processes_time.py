"""Windows a second of a training by one process and by two that torchrun starts, in turn.

    python benchmarks/processes_time.py STORE

Each process has one thread. Rates are of the clock, without validations and start-up, so the
machine should have nothing else to do. Appends the rows to runs/processes_time/results.jsonl, or to
--results, and prints a table.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ucfrec.code_version import code_version
from ucfrec.fitting.metrics_log import read_metrics
from ucfrec.provenance import provenance
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import append_rows
from ucfrec.reporting.tables import markdown_table

RESULTS = Path("runs/processes_time/results.jsonl")
ALONE = [sys.executable, "-m", "ucfrec"]
TOGETHER = ["torchrun", "--nproc-per-node", "2", "--master-port", "29517", "-m", "ucfrec"]


def windows_per_second(start: list[str], store: Path, batch: int, steps: int, dim: int) -> float:
    """The rate of a training, started by `start`, after its first third."""
    values = {
        "train.batch_size": batch,
        "train.steps": steps,
        "train.validate_every": max(1, steps // 3),
        "train.warmup_steps": 1,
        "policy.dim": dim,
        "augment.copies": 0,
        "rule.choose": "false",
    }
    settings = [part for key, value in values.items() for part in ("--set", f"{key}={value}")]
    launcher = [sys.executable, "-m", "torch.distributed.run", *start[1:]]
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [*(start if start is ALONE else launcher), "train", str(store), "--out", str(run)]
        subprocess.run(
            [*command, *settings],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            check=True,
            capture_output=True,
        )
        rates = read_metrics(run / "policy")["samples_per_second"]
        return float(np.median([rates[step] for step in sorted(rates)[1:]]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path, help="episode store")
    parser.add_argument("--dim", type=int, default=128, help="width of the policy (default: 128)")
    parser.add_argument(
        "--batch", type=int, action="append", help="windows of a step; repeatable (64, 256, 1024)"
    )
    parser.add_argument("--windows", type=int, default=6000, help="windows of a training (6000)")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds (default: 5)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of result rows")
    options = parser.parse_args()
    lines = []
    for batch in options.batch or (64, 256, 1024):
        steps = max(6, options.windows // batch)
        rates = np.array(
            [
                [
                    windows_per_second(start, options.store, batch, steps, options.dim)
                    for start in (ALONE, TOGETHER)
                ]
                for _ in range(options.rounds)
            ]
        )
        low, middle, high = np.quantile(rates[:, 1] / rates[:, 0], [0.1, 0.5, 0.9])
        lines.append((batch, f"{middle:.2f} [{low:.2f}, {high:.2f}]"))
        row = ResultRow(
            suite="processes-time",
            table="processes-time",
            task=f"batch {batch}",
            method="two processes",
            policy="ucf",
            conditions={"dim": options.dim, "batch": batch, "rounds": options.rounds},
            code_version=code_version(Path(__file__), "ucfrec.runs.policy_fit"),
            metric="ratio",
            metrics={"ratio": middle, "ratio_10": low, "ratio_90": high},
            wall_time_s=float((steps * batch / rates).sum()),
            **provenance(),
        )
        append_rows(options.results, [row])
    print(markdown_table(("batch", "windows a second, two / one, median [10%, 90%]"), lines))


if __name__ == "__main__":
    main()
