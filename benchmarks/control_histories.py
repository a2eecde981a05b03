"""Why UCF earns little on some files: what its history is worth once it holds its own actions.

    python benchmarks/control_histories.py --data $UCFREC_DATA/control --out runs/control

Rows of the equal-time table that learn from the best quarter (runs of `ucfrec-control benchmark` in
--out are taken, not repeated), with a history of 20 steps and with shorter ones at as many
predictions per update. Of each the score, and the action loss at every step of up to 24 validation
episodes: with the logged actions in the history, as in the validation loss, and with the policy's
own at these states, nearer to how it acts. --show-only prints the tables from the rows in
--results.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import SequencePolicy
from ucfrec.reporting.grid import Measurement, run_grid
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.reporting.rows_file import benchmarking, read_rows
from ucfrec.reporting.statistics import grouped
from ucfrec.reporting.tables import markdown_table
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.benchmark.budgets import BUDGETS, Budget
from ucfrec_control.benchmark.cells import Cell, config, key, measure_scores
from ucfrec_control.benchmark.folders import run_name
from ucfrec_control.benchmark.methods import EQUAL_TIME
from ucfrec_control.benchmark.plan import cells_of
from ucfrec_control.benchmark.tables import score_table

RESULTS = Path(__file__).parent / "results" / "control_histories.jsonl"
SUITE = "histories"
METHODS = (
    *("ucf-wo-count-best-25-x2", "lsdt-wo-time-best-25", "dt-wo-time-best-25"),
    "dc-wo-time-best-25",
)
CONTEXTS = (1, 5, 20)
PREDICTIONS = 320
"""Per update, as in the small budget: 16 windows of 20 steps."""
EPISODES = 24


@torch.no_grad()
def losses(policy: SequencePolicy, episodes: EpisodeStore) -> dict[str, float]:
    """Mean action loss over all steps: `loss` with the logged history, `own_loss` with the own."""
    history = policy.config.context - 1
    taken: Tensor | None = None  # (E, K, A)
    found: list[tuple[Tensor, Tensor]] = []
    for step in range(int(episodes.lengths.max())):
        rows: IntArray = np.flatnonzero(episodes.lengths > step)
        logged = episodes.windows(rows, np.full(len(rows), step), history + 1)
        if taken is None:
            taken = torch.zeros(episodes.n_episodes, history + 1, logged.actions.shape[-1])
        actions = taken[rows] * logged.mask.unsqueeze(-1)
        actions[:, -1] = logged.actions[:, -1]
        own = replace(logged, actions=actions)
        found.append((step_losses(policy, logged), step_losses(policy, own)))
        # The slot of the step itself is filled before the next step moves it into the history.
        taken[rows, -1] = policy.act(own)
        taken = taken.roll(-1, dims=1)
    logged_loss, own_loss = (float(torch.cat(each).mean()) for each in zip(*found, strict=True))
    return {"loss": logged_loss, "own_loss": own_loss}


def step_losses(policy: SequencePolicy, windows: Windows) -> Tensor:
    """(B,) action loss at the last step of each window."""
    features = policy.last_features(policy.normalized(windows))
    return policy.head.losses(features, windows.actions[:, -1])


def measure(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """The row of the last checkpoint, with both losses; trains if need be."""
    row = next(row for row in measure_scores(cell, row_key) if row.checkpoint == "last")
    _, validation = training_views(EpisodeStore.open(cell.store))
    drawn = np.random.default_rng(0).permutation(validation.n_episodes)[:EPISODES]
    found = losses(TrainedPolicy.load(cell.run, "last").policy, validation.select(np.sort(drawn)))
    return [replace(row, metrics={**row.metrics, **found})]


def cells(
    data: Path, out: Path, budget: Budget, methods: Sequence[str], contexts: Sequence[int]
) -> Iterator[Cell]:
    """Equal-time cells with every length of the history; the last of `CONTEXTS` is the preset's."""
    for cell in cells_of(data, out, budget, "small", EQUAL_TIME, methods):
        for steps in contexts:
            if steps == CONTEXTS[-1]:
                yield replace(cell, suite=SUITE)
                continue
            name = f"{cell.method}-context-{steps}"
            size = (f"policy.context={steps}", f"train.batch_size={PREDICTIONS // steps}")
            yield replace(
                cell,
                suite=SUITE,
                method=name,
                settings=(*cell.settings, *size),
                run=cell.run.with_name(run_name(name, cell.code_version, cell.seed)),
            )


def tables(rows: list[ResultRow]) -> str:
    """Scores by method and file; and both losses by file and method, means over training seeds."""
    lines = score_table(rows, "last")
    scores = markdown_table(list(lines[0]), [list(line.values()) for line in lines])
    by_file = grouped(rows, lambda row: (row.task, row.method))
    means = [
        [*names, *(f"{mean_of(own, each):.4f}" for each in ("loss", "own_loss"))]
        for names, own in by_file.items()
    ]
    names = ["file", "method", "loss, logged actions", "loss, own actions"]
    return f"{scores}\n\n{markdown_table(names, means)}"


def mean_of(rows: Sequence[ResultRow], metric: str) -> float:
    return sum(row.metrics[metric] for row in rows) / len(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder of the HDF5 files")
    parser.add_argument("--out", type=Path, help="folder for stores and runs; resumed")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--file", action="append", help="repeatable (all nine)")
    parser.add_argument("--method", action="append", choices=METHODS, help="repeatable (all)")
    parser.add_argument(
        "--context", action="append", type=int, choices=CONTEXTS, help="repeatable (all)"
    )
    parser.add_argument("--seeds", type=int, default=1, help="training seeds, from 0")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--show-only", action="store_true")
    options = parser.parse_args()
    if not options.show_only:
        if options.data is None or options.out is None:
            parser.error("--data and --out are needed, or --show-only")
        small = BUDGETS["small"]
        budget = replace(small, files=options.file or small.files, seeds=options.seeds)
        how = Measurement(key, config, measure)
        with benchmarking(options.results):
            methods, contexts = options.method or METHODS, options.context or CONTEXTS
            planned = cells(options.data, options.out, budget, methods, contexts)
            by_seed = sorted(planned, key=attrgetter("seed"))
            run_grid(by_seed, how, options.results, options.workers, SUITE)
    rows = read_rows(options.results)
    print(tables(rows) if rows else f"{options.results} has no rows")


if __name__ == "__main__":
    main()
