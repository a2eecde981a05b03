"""Choose learning rates or lengths of history for the control benchmark; resumes.

    python benchmarks/control_search.py rates --data DATA --budget small
    python benchmarks/control_search.py contexts --data DATA --budget medium

Both train on three files, each task and kind of data once. Rates: lowest validation loss, in the
mean over files, relative to the best of the method there; without augmentation. Contexts: highest
score in episodes of another seed than the reported ones. The chosen rates go into
`control/ucfrec_control/benchmark/rates.toml`, contexts into `ucfrec-control benchmark --context`.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ucfrec import schema
from ucfrec.benchmark.cells import Budget, Cell, Measurement, Method, Plan, Task, open_store
from ucfrec.benchmark.grid import run_grid
from ucfrec.episodes.store import EpisodeStore
from ucfrec.provenance import provenance
from ucfrec.reporting.tables import format_rows
from ucfrec.results.rows import ResultRow, RowKey
from ucfrec.results.statistics import grouped, summary
from ucfrec.runs.record import RunRecord
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.measure import RATE, SCORE_MEASUREMENT, config, train
from ucfrec_control.benchmark.methods import MAIN
from ucfrec_control.benchmark.plan import SEARCHED, presets_of, score_cells, set_contexts
from ucfrec_control.benchmark.seeds import average_seeds
from ucfrec_control.data.distractor import zoo_store
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.training.rl_baselines import ALGORITHMS, RLPolicy

FILES = ("halfcheetah_medium-expert-zoo", "hopper_medium-zoo", "walker2d_mixed-zoo")
RATES = {"small": (2e-3, 6e-3, 2e-2), "medium": (3e-4, 1e-3, 3e-3), "full": (1e-4, 3e-4, 1e-3)}
CONTEXTS = (8, 20)
WITH_HISTORY = ("ucf-wo-count", "dc-wo-time", "dt-wo-time", "lsdt-wo-time")
SEARCH_SEED = 2000


def rate_cells(data: Path, out: Path, budget: Budget) -> Iterator[Cell]:
    """Every policy at every rate, without augmentation and evaluation."""
    budget = replace(budget, evaluation=replace(budget.evaluation, episodes=0))

    def settings(rate: float, name: str, method: Method) -> tuple[str, ...]:
        policy_settings = budget.of_policies.get(method.policy, ())
        if method.policy in ALGORITHMS:
            return (*policy_settings, f"{RATE}={rate:g}")
        searched = ("augment.copies=0", f"train.{RATE}={rate:g}")
        return (*budget.settings, *policy_settings, *method.settings, *searched)

    for file in FILES:
        store = zoo_store(data, out / "stores", file)
        for rate in RATES[budget.name]:
            at_rate = partial(settings, rate)
            plan = Plan("rates", out / budget.name, budget, at_rate, presets_of)
            yield from plan.list_trained(
                f"{rate:g}", Task(file, store, conditions={RATE: rate}), SEARCHED
            )


def measure_rate(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train at a rate; returns a row with the validation loss."""
    record = train(cell)
    if isinstance(record, RunRecord):
        loss = record.finished.best_validation
    else:
        assert cell.run is not None
        loss = action_loss(cell.run, open_store(cell))
    row = ResultRow(
        **vars(row_key),
        metric="validation_loss",
        metrics={"validation_loss": loss, "steps": float(record.finished.steps)},
        wall_time_s=record.wall_time_s,
        **provenance(PACKAGES),
    )
    return [row]


def action_loss(run: Path, store: EpisodeStore) -> float:
    """Mean squared error of the actor's mean actions at all validation steps of `store`, whose
    training `run` is."""
    validation = store.split("validation")
    steps = validation.all_steps()
    policy = RLPolicy(run)
    live = np.ones(len(steps[0]), dtype=bool)
    taken, _ = policy.act(validation.step_values(schema.OBSERVATION, *steps), live)
    return float(np.mean((taken - validation.step_values(schema.ACTION, *steps)) ** 2))


def context_cells(data: Path, out: Path, budget: Budget) -> Iterator[Cell]:
    """Every method with a history at every length, scored in other episodes."""
    budget = replace(
        budget, tasks=FILES, seeds=1, evaluation=replace(budget.evaluation, seed=SEARCH_SEED)
    )
    for context in CONTEXTS:
        longer = set_contexts(budget, dict.fromkeys(WITH_HISTORY, context))
        for cell in score_cells(data, out, longer, MAIN, WITH_HISTORY):
            yield replace(cell, suite="contexts", table="contexts", conditions={"context": context})


def best(rows: Sequence[ResultRow], condition: str, relative: bool) -> dict[str, object]:
    """The value of `condition` with the lowest (relative) or the highest mean, by method."""
    choice: dict[str, object] = {}
    for method, own in grouped(rows, lambda row: row.method).items():
        tasks = grouped(own, lambda row: row.task).items()
        lowest = {task: min(row.value for row in task_rows) for task, task_rows in tasks}
        scale = {task: -1 / least if relative else 1.0 for task, least in lowest.items()}
        values = grouped(own, lambda row: row.conditions[condition])
        choice[method] = max(
            values, key=lambda v: summary(row.value * scale[row.task] for row in values[v]).mean
        )
    return choice


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("search", choices=("rates", "contexts"))
    parser.add_argument("--data", type=Path, required=True, help="folder of the HDF5 files")
    parser.add_argument("--budget", choices=list(RATES), default="small")
    parser.add_argument("--out", type=Path, default=Path("runs/control"))
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    budget, results = budget_of(MAIN, options.budget), options.out / "results.jsonl"
    if options.search == "rates":
        condition, metric = RATE, "validation_loss"
        cells = list(rate_cells(options.data, options.out, replace(budget, seeds=1)))
        rows = run_grid(cells, Measurement(measure_rate, config), results, options.workers)
    else:
        condition, metric = "context", "score"
        cells = list(context_cells(options.data, options.out, budget))
        rows = run_grid(cells, SCORE_MEASUREMENT, results, options.workers)
        rows = [row for row in rows if row.checkpoint == "last"]
    by = ("task", "method", condition)
    print(format_rows(average_seeds([row.as_line() for row in rows], by, (metric,)), (*by, metric)))
    for method, value in best(rows, condition, options.search == "rates").items():
        print(f"{method} = {value}")


if __name__ == "__main__":
    main()
