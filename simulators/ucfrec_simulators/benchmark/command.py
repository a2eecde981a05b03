"""`ucfrec benchmark recommendation`: its tables; resumable, cells run in parallel processes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError
from ucfrec.plugins import Benchmark, BenchmarkRequest
from ucfrec.reporting.grid import run_grid
from ucfrec.reporting.result_row import ResultRow
from ucfrec_simulators.benchmark.cells import MEASUREMENT
from ucfrec_simulators.benchmark.estimate import announcement
from ucfrec_simulators.benchmark.methods import ADDITIONS, METHODS, SCREENED
from ucfrec_simulators.benchmark.plan import BUDGETS, Plan
from ucfrec_simulators.benchmark.plots import (
    plot_additions,
    plot_distractor,
    plot_methods,
    plot_sweeps,
)
from ucfrec_simulators.benchmark.tables import (
    distractor_table,
    method_table,
    sweep_table,
)
from ucfrec_simulators.benchmark.tasks import TASKS

TABLES: Final = ("main", "additions", "distractor", "sweeps")


def run(request: BenchmarkRequest) -> str:
    """Measure the cells of the tables that have no row yet.

    Plots are written to `out/budget/plots` if matplotlib is installed.

    Returns:
        The tables as Markdown.

    Raises:
        InputError: the budget is unknown, another table than main is asked of a single
            environment, or cells failed.
    """
    if request.budget not in BUDGETS:
        raise InputError(f"unknown budget {request.budget}; choose one of {', '.join(BUDGETS)}")
    folder, budget = request.out / request.budget, BUDGETS[request.budget]
    if request.evaluation_seed is not None:
        evaluation = replace(budget.evaluation, seed=request.evaluation_seed)
        budget = replace(budget, evaluation=evaluation)
    if request.training_seeds is not None:
        seeds = request.training_seeds
        if seeds < 1:
            raise InputError(f"--training-seeds is {seeds}; train at least one")
        budget = replace(budget, seeds=seeds)
    if request.logs is not None:
        if request.logs < 1:
            raise InputError(f"--logs is {request.logs}; train on at least one")
        budget = replace(budget, logs=request.logs)
    _require_known(request)
    plan = Plan(
        folder, budget, request.budget, request.log_seed, request.environment, request.tasks
    )
    tables, parts = request.tables, []
    if request.environment is not None:
        tables = [table for table in tables if table == "main"]
        if not tables:
            raise InputError("--env gives the table main only; leave out --table")
    else:
        parts = [
            f"{name} is left out: its files are not in the data folder, or its package is not "
            "installed"
            for name in plan.missing()
        ]
    again = request.again
    plotted = find_spec("matplotlib") is not None
    for table in tables:
        cells = [
            cell
            for cell in getattr(plan, table)()
            if not request.methods or cell.run is None or cell.method in request.methods
        ]
        said = announcement(request.workers)
        rows = run_grid(cells, MEASUREMENT, request.results, request.workers, table, said, again)
        parts.append(_shown(table, rows))
        if plotted:
            for _, _, draw in _SHOWN[table]:
                draw(rows, folder / "plots")
    pictures = f"pictures: {folder / 'plots'}" if plotted else "no pictures: install matplotlib"
    return "\n\n".join([*parts, pictures])


def _require_known(request: BenchmarkRequest) -> None:
    for kind, given, known in (
        ("task", request.tasks, TASKS),
        ("method", request.methods, {**METHODS, **ADDITIONS, **SCREENED}),
    ):
        if unknown := [name for name in given if name not in known]:
            raise InputError(f"no {kind} is called {unknown[0]!r}; choose from {', '.join(known)}")


def show(tables: Sequence[str], rows: Sequence[ResultRow]) -> str:
    """The tables that have rows in `rows`, as Markdown; nothing is measured."""
    by_table = {table: [row for row in rows if row.table == table] for table in tables}
    return "\n\n".join(_shown(table, rows) for table, rows in by_table.items() if rows)


def _shown(table: str, rows: Sequence[ResultRow]) -> str:
    return "\n\n".join(f"## {title}\n\n{as_table(rows)}" for title, as_table, _ in _SHOWN[table])


_Shown = tuple[
    str,
    Callable[[Sequence[ResultRow]], str],
    Callable[[Sequence[ResultRow], Path], list[Path]],
]
_SHOWN: Final[Mapping[str, tuple[_Shown, ...]]] = {
    "main": (("Methods", method_table, plot_methods),),
    "additions": (("Additions to the paper, one by one", method_table, plot_additions),),
    "sweeps": (("Settings of UCF", sweep_table, plot_sweeps),),
    "distractor": (("A distractor that causes nothing", distractor_table, plot_distractor),),
}

BENCHMARK: Final = Benchmark(
    summary="Table 2 of the paper with built-in policies, ablations, additions, sweeps of UCF, a "
    "distractor",
    tables=TABLES,
    run=run,
    show=show,
)
