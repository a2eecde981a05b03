"""A suite of tables: what a package declares as a benchmark, measured and shown in one way."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ucfrec.benchmark.cells import Budget, Cell, Measurement, Method
from ucfrec.benchmark.grid import run_grid, select_names
from ucfrec.benchmark.tables import note_updates
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Environment
from ucfrec.results.rows import ResultRow

Rows = Sequence[ResultRow]


@dataclass(frozen=True)
class Shown:
    """How the rows of a table are shown."""

    title: str
    markdown: Callable[[Rows], str]

    def show(self, rows: Rows) -> str:
        """The table between its title and notes, as Markdown."""
        return "\n\n".join([f"## {self.title}", self.markdown(rows), *note_updates(rows)])


class Cells(Protocol):
    """The cells of a suite's tables."""

    def cells(self, table: str) -> Iterable[Cell]:
        """The cells of a table."""

    def missing(self) -> Sequence[str]:
        """Tasks that are excluded because their files or packages are missing."""


@dataclass(frozen=True)
class Benchmark:
    """A set of tables that `ucfrec benchmark NAME` measures and prints."""

    summary: str
    """One line for `--help`."""
    tables: Mapping[str, Shown]
    """By name, in the order in which they are measured."""
    budgets: Mapping[str, Budget]
    tasks: Collection[str]
    """Names that `BenchmarkRequest.tasks` may have."""
    methods: Mapping[str, Method]
    """By name, which `BenchmarkRequest.methods` may have."""
    plan: Callable[["BenchmarkRequest", Budget], Cells]
    how: Measurement


@dataclass(frozen=True)
class BenchmarkRequest:
    """Which tables of a benchmark are measured, and where the results are written."""

    budget: str
    """Name of the budget: how many seeds, training steps and episodes are spent on a cell."""
    tables: Sequence[str]
    """Names of the tables to measure."""
    out: Path
    """Folder for logs, stores, runs and result rows; resumed."""
    results: Path
    """File to which result rows are added."""
    workers: int
    """Parallel processes, one thread each."""
    log_seed: int = 0
    """Seed of the first simulated log of a task; the others follow it."""
    logs: int | None = None
    """Logs of each task: simulated with as many seeds, or parts of a given log, 1 for all of it;
    None for the budget's."""
    evaluation_seed: int | None = None
    """Seed of the evaluated episodes, the same for every training seed; None for the budget's."""
    environment: Environment | None = None
    """An environment that is measured instead of the suite's tasks; None for these."""
    tasks: Sequence[str] = ()
    """Names of the only tasks to measure; empty for all."""
    methods: Sequence[str] = ()
    """Names of the only methods to measure; empty for all."""
    training_seeds: int | None = None
    """Training seeds of every method, from 0; None for the budget's."""
    again: bool = False
    """Remove the rows and runs of the cells first; resume without it."""


def measure(suite: Benchmark, request: BenchmarkRequest) -> str:
    """The tables; measures their cells that have no row yet. InputError if the budget, a task or a
    method is unknown, another table than main is requested of a single environment, or cells
    failed."""
    select_names(suite.budgets, [request.budget], "budget")
    select_names(suite.tasks, request.tasks, "task")
    select_names(suite.methods, request.methods, "method")
    budget = suite.budgets[request.budget].narrow(
        seeds=request.training_seeds, logs=request.logs, evaluation_seed=request.evaluation_seed
    )
    tables = list(request.tables)
    if request.environment is not None and not (tables := [t for t in tables if t == "main"]):
        raise InputError("--env gives the table main only; omit --table")
    plan = suite.plan(request, budget)
    parts = [
        f"{name} is excluded: its files are not in the data folder, or its package is not installed"
        for name in plan.missing()
    ]
    for table in tables:
        cells = [
            cell
            for cell in plan.cells(table)
            if not request.methods or cell.run is None or cell.method in request.methods
        ]
        rows = run_grid(cells, suite.how, request.results, request.workers, table, request.again)
        parts.append(suite.tables[table].show(rows))
    return "\n\n".join(parts)


def show(suite: Benchmark, tables: Sequence[str], rows: Rows) -> str:
    """The tables that have rows in `rows`, as Markdown; nothing is measured."""
    by_table = {table: [row for row in rows if row.table == table] for table in tables}
    return "\n\n".join(suite.tables[t].show(group) for t, group in by_table.items() if group)
