"""What a distractor costs the learners that were trained with it (Figures 3 and 4, Appendix G.4).

Every learner is trained on the plain data and on the same data with a distractor in its states, and
evaluated where the distractor is fixed to 0. Two such trainings differ by their luck too; what one
policy earns where it is fixed to 1 instead tells of the distractor alone.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ucfrec.reporting.grid import chosen, run_grid
from ucfrec.reporting.result_row import ResultRow
from ucfrec_control.benchmark.cells import ROBUSTNESS, ROBUSTNESS_MEASUREMENT, Cell, code_of
from ucfrec_control.benchmark.plan import BUDGETS as SCORE_BUDGETS
from ucfrec_control.benchmark.plan import METHODS as LEARNERS
from ucfrec_control.benchmark.plan import Budget, run_name, stores_of
from ucfrec_control.data.distractor import CLEAN, DISTRACTORS, zoo_store

SCREENED = {"ucf-screened": "copies", "ucf-dropped": "drop"}
"""UCF with copies that intervene on what screening flags, and UCF that is not shown it."""
METHODS = ("dt", "dc", "lsdt", "ucf", "ucf-wo-count", "ucf-wo-arch", *SCREENED)
"""Rows of `ucfrec_control.benchmark.plan`, and those."""

BUDGETS = {
    # As the benchmark's, with fewer seeds and steps and half the history; no method and no
    # distractor is left out.
    "small": replace(
        SCORE_BUDGETS["small"],
        seeds=1,
        settings=(*SCORE_BUDGETS["small"].settings, "train.steps=3000", "policy.context=10"),
    ),
    "full": SCORE_BUDGETS["full"],
}
SHOWN = ("clean", "score", "drop", "score_at_one")
SHOWN_LOSSES = ("loss", "loss_at_zero", "rise")
_CODE = (zoo_store.__module__, "ucfrec_control.learners.held_out_losses")
"""Beside what every cell runs through."""


def robustness(
    data: Path,
    folder: Path,
    results: Path,
    budget: Budget,
    name: str,
    workers: int,
    methods: Sequence[str] = (),
) -> list[ResultRow]:
    """Train and evaluate whatever has no row in `results` yet; returns the rows of all cells.

    Args:
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        results: JSON lines.
        name: of the budget, for the rows.
        workers: processes, of one thread each.
        methods: of `METHODS`; empty for all.

    Raises:
        InputError: a file is missing, a method is unknown, `results` holds something else, or cells
            failed.
    """
    cells = list(_cells(data, folder, budget, name, chosen(METHODS, methods, "method")))
    return run_grid(cells, ROBUSTNESS_MEASUREMENT, results, workers, "robustness")


def _cells(
    data: Path, folder: Path, budget: Budget, name: str, methods: Sequence[str]
) -> Iterator[Cell]:
    for file in budget.files:
        for distractor in DISTRACTORS:
            store = zoo_store(data, stores_of(folder), file, distractor)
            runs = folder / f"robustness-{name}" / file / distractor
            for method in methods:
                # A line of the score tables is trained.
                learner, own = LEARNERS["ucf" if method in SCREENED else method]
                code = code_of(learner, *_CODE)
                for seed in range(budget.seeds):
                    yield Cell(
                        suite=ROBUSTNESS,
                        table=ROBUSTNESS,
                        budget=name,
                        file=file,
                        method=method,
                        learner=learner,
                        settings=(*budget.settings_of(learner), *own),
                        store=store,
                        run=runs / run_name(method, code, seed),
                        seed=seed,
                        episodes=budget.episodes,
                        evaluation_seed=budget.evaluation_seed,
                        code_version=code,
                        distractor=distractor,
                        screening=SCREENED.get(method),
                    )


def drops(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """What every distractor took from a method, where a dataset and seed has a clean row too.

    `clean` and `score` are the normalised scores without and with the distractor, which is fixed to
    0, `drop` the share of `clean` that is lost, in percent: negative where nothing was lost, NaN
    where `clean` is not above 0. `score_at_one` is what the policy of `score` earns, of the same
    starts, where it is fixed to 1. Of rows that say the same, the last counts.

    Args:
        rows: what `robustness` returns, of one budget.
    """
    last = {(_pair(row), row.conditions["distractor"]): row.metrics for row in rows}
    found = []
    for (pair, distractor), metrics in last.items():
        plain = last.get((pair, CLEAN))
        if distractor == CLEAN or plain is None:
            continue
        clean, score = plain["score"], metrics["score"]
        lost = 100 * (clean - score) / clean if clean > 0 else float("nan")
        values = (clean, score, lost, metrics.get("score_at_one"))
        names = ("task", "method", "training_seed", "distractor")
        found.append(dict(zip((*names, *SHOWN), (*pair, distractor, *values), strict=True)))
    return found


def loss_rises(rows: Sequence[ResultRow]) -> list[Mapping[str, Any]]:
    """Rows with a distractor, and as `rise` by how many percent of `loss` fixing it to 0 raises the
    held-out action loss."""
    return [
        {**row.as_line(), "rise": 100 * (row.metrics["loss_at_zero"] / row.metrics["loss"] - 1)}
        for row in rows
        if row.conditions["distractor"] != CLEAN and "loss" in row.metrics
    ]


def _pair(row: ResultRow) -> tuple[str, str, int | None]:
    """What a row with and one without a distractor have in common."""
    return row.task, row.method, row.training_seed
