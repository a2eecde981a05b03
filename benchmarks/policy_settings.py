"""Validation loss of UCF by mask loss weight λ and by weight of the parent action a_{t−1}.

    python benchmarks/policy_settings.py --store STORE... --out runs/settings

Trains UCF without edited copies on each store with each pair of settings and compares validation
losses only; no simulator is used. Appends the rows to results.jsonl in
--out, or to --results, and prints a table.
"""

import argparse
import itertools
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.provenance import provenance
from ucfrec.reporting.grid import Measurement, run_grid
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.run import train_run

DEMO_SIZE = ("policy.dim=64", "policy.context=10", "train.learning_rate=1e-3", "augment.copies=0")


@dataclass(frozen=True)
class Cell:
    """One training: a store and a pair of settings."""

    store: Path
    out: Path
    lambda_mask: float
    parent_action: float
    steps: int

    @property
    def config(self) -> Config:
        """Training configuration of the cell."""
        given = [f"policy.lambda_mask={self.lambda_mask}"]
        given += [f"policy.parent_action={self.parent_action}", f"train.steps={self.steps}"]
        return resolve_config("ucf", None, [*DEMO_SIZE, *given])


def key(cell: Cell) -> RowKey:
    return RowKey(
        suite="policy-settings",
        table="policy-settings",
        task=cell.store.parent.name,
        method="ucf",
        policy="ucf",
        training_seed=0,
        conditions={"lambda_mask": cell.lambda_mask, "parent_action": cell.parent_action},
        code_version=code_version(Path(__file__), "ucfrec.runs.run", "ucfrec.policies.ucf"),
        data_fingerprint=EpisodeStore.open(cell.store).record.fingerprint,
    )


def config(cell: Cell) -> dict[str, Any]:
    return asdict(cell.config)


def measure(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    name = f"{cell.lambda_mask}-{cell.parent_action}-{row_key.code_version}"
    folder = cell.out / cell.store.parent.name / name
    record = train_run(EpisodeStore.open(cell.store), folder, cell.config)
    loss = {"validation_loss": record.finished.best_validation}
    given = {"metric": "validation_loss", "metrics": loss, "wall_time_s": record.wall_time_s}
    return [ResultRow(**vars(row_key), **given, **provenance())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, nargs="+", required=True, help="episode stores")
    parser.add_argument("--out", type=Path, required=True, help="folder for the runs; resumed")
    parser.add_argument(
        "--results", type=Path, help="file of result rows (default: results.jsonl in --out)"
    )
    parser.add_argument(
        "--lambda-mask",
        type=float,
        nargs="+",
        default=[0, 0.01, 0.03, 0.1],
        help="values of policy.lambda_mask (default: 0 0.01 0.03 0.1)",
    )
    parser.add_argument(
        "--parent-action",
        type=float,
        nargs="+",
        default=[0, 0.3],
        help="values of policy.parent_action (default: 0 0.3)",
    )
    parser.add_argument(
        "--steps", type=int, default=1000, help="steps of each training (default: 1000)"
    )
    options = parser.parse_args()
    pairs = list(itertools.product(options.lambda_mask, options.parent_action))
    cells = [
        Cell(store, options.out, weight, action, options.steps)
        for store in options.store
        for weight, action in pairs
    ]
    results = options.results or options.out / "results.jsonl"
    rows = run_grid(cells, Measurement(key, config, measure), results, 2, "policy settings")
    lines = [
        (
            row.task,
            *(f"{row.conditions[name]:g}" for name in ("lambda_mask", "parent_action")),
            f"{row.value:.4f}",
        )
        for row in rows
    ]
    print(markdown_table(("store", "λ", "weight of a_{t−1}", "validation loss"), lines))


if __name__ == "__main__":
    main()
