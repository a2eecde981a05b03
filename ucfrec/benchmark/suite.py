"""A suite of tables: what a package declares as a benchmark, measured and shown in one way.

How long it takes is estimated from what the suite says of the cost of its parts.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from ucfrec.benchmark.cells import Budget, Cell
from ucfrec.benchmark.grid import Measurement, run_grid
from ucfrec.errors import InputError
from ucfrec.evaluation.environment import Environment
from ucfrec.files.atomic import read_json
from ucfrec.results.row import ResultRow
from ucfrec.runs.record import RUN


@dataclass(frozen=True)
class Costs:
    """CPU seconds of the parts of a cell."""

    training: Callable[[Cell], float]
    """Of the updates of the cell's policy."""
    evaluation: Callable[[Cell], float]
    note: str
    """Where these numbers come from, and what they exclude."""
    stages: Callable[[Cell], Mapping[object, float]] = lambda cell: {}
    """Of the stages before and after the updates, by a key that cells with a common one share."""


def announcement(costs: Costs, workers: int) -> Callable[[Sequence[Cell]], str]:
    """What a benchmark of so many processes says of the cells that are left, before it starts."""

    def text(cells: Sequence[Cell]) -> str:
        hours = estimated_hours(cells, costs) / workers
        return f"about {hours:.1f} hours with --workers {workers}, {costs.note}"

    return text


def estimated_hours(cells: Sequence[Cell], costs: Costs) -> float:
    """CPU hours of `cells`; what several share is counted once, finished trainings are not."""
    seconds: dict[object, float] = {}
    for cell in cells:
        if cell.run is not None and not _finished(cell.run):
            seconds[cell.run] = costs.training(cell)
            seconds |= costs.stages(cell)
    return (sum(map(costs.evaluation, cells)) + sum(seconds.values())) / 3600


def _finished(run: Path) -> bool:
    return (run / RUN).exists() and "policy" in read_json(run / RUN)


Rows = Sequence[ResultRow]


@dataclass(frozen=True)
class Shown:
    """How the rows of a table are shown."""

    title: str
    markdown: Callable[[Rows], str]
    plot: Callable[[Rows, Path], list[Path]]
    """Draws into a folder; returns the files."""


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
    methods: Collection[str]
    """Names that `BenchmarkRequest.methods` may have."""
    plan: Callable[["BenchmarkRequest", Budget], Cells]
    how: Measurement[Cell]
    costs: Costs


@dataclass(frozen=True)
class BenchmarkRequest:
    """Which tables of a benchmark are measured, and where the results are written."""

    budget: str
    """Name of the budget: how many seeds, training steps and episodes are spent on a cell."""
    tables: Sequence[str]
    """Names of the tables to measure."""
    out: Path
    """Folder for logs, stores and runs."""
    results: Path
    """File to which result rows are added."""
    workers: int
    """Number of parallel processes."""
    log_seed: int = 0
    """Seed of the first simulated log of a task; the others have the seeds after it."""
    logs: int | None = None
    """Number of logs of each task; None for the budget's."""
    evaluation_seed: int | None = None
    """Seed of the evaluation episodes; None stands for the budget's."""
    environment: Environment | None = None
    """An environment that is measured instead of the suite's tasks; None for these."""
    tasks: Sequence[str] = ()
    """Names of the only tasks to measure; empty for all."""
    methods: Sequence[str] = ()
    """Names of the only methods to measure; empty for all."""
    training_seeds: int | None = None
    """Number of training seeds of each cell; None for the budget's."""
    again: bool = False
    """Whether cells that have rows are measured again."""


def measure(suite: Benchmark, request: BenchmarkRequest) -> str:
    """Measure the cells of the tables that have no row yet.

    Plots are written to `out/budget/plots` if matplotlib is installed.

    Raises:
        InputError: the budget, a task or a method is unknown, another table than main is requested
            of a single environment, or cells failed.
    """
    if request.budget not in suite.budgets:
        known = ", ".join(suite.budgets)
        raise InputError(f"unknown budget {request.budget}; choose one of {known}")
    budget = suite.budgets[request.budget].narrowed(
        seeds=request.training_seeds, logs=request.logs, evaluation_seed=request.evaluation_seed
    )
    _require_known("task", request.tasks, suite.tasks)
    _require_known("method", request.methods, suite.methods)
    tables = list(request.tables)
    if request.environment is not None and not (tables := [t for t in tables if t == "main"]):
        raise InputError("--env gives the table main only; omit --table")
    plan = suite.plan(request, budget)
    parts = [
        f"{name} is excluded: its files are not in the data folder, or its package is not installed"
        for name in plan.missing()
    ]
    plots = request.out / request.budget / "plots"
    drawn = find_spec("matplotlib") is not None
    for table in tables:
        cells = [
            cell
            for cell in plan.cells(table)
            if not request.methods or cell.run is None or cell.method in request.methods
        ]
        announce = announcement(suite.costs, request.workers)
        rows = run_grid(
            cells, suite.how, request.results, request.workers, table, announce, request.again
        )
        parts.append(_shown(suite.tables[table], rows))
        if drawn:
            suite.tables[table].plot(rows, plots)
    return "\n\n".join(
        [*parts, f"pictures: {plots}" if drawn else "no pictures: install matplotlib"]
    )


def show(suite: Benchmark, tables: Sequence[str], rows: Rows) -> str:
    """The tables that have rows in `rows`, as Markdown; nothing is measured."""
    by_table = {table: [row for row in rows if row.table == table] for table in tables}
    return "\n\n".join(_shown(suite.tables[t], own) for t, own in by_table.items() if own)


def _shown(table: Shown, rows: Rows) -> str:
    return f"## {table.title}\n\n{table.markdown(rows)}"


def _require_known(kind: str, given: Sequence[str], known: Collection[str]) -> None:
    if unknown := [name for name in given if name not in known]:
        raise InputError(f"no {kind} is called {unknown[0]!r}; choose from {', '.join(known)}")
