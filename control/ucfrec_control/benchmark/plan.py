"""Every learner on the zoo files (Tables 1 and 3), and sweeps over UCF's settings (resumable)."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from ucfrec.reporting.grid import chosen
from ucfrec.reporting.result_row import ResultRow
from ucfrec_control.benchmark.budgets import Budget
from ucfrec_control.benchmark.cells import SCORE_MEASUREMENT, SCORES, Cell
from ucfrec_control.benchmark.folders import stages_of, stores_of
from ucfrec_control.benchmark.methods import MAIN, TABLES
from ucfrec_control.benchmark.rates import rl_settings_of, settings_of
from ucfrec_control.benchmark.run_cells import run_cells
from ucfrec_control.data.distractor import zoo_store


def benchmark(
    data: Path,
    folder: Path,
    results: Path,
    budget: Budget,
    name: str,
    workers: int,
    table: str = MAIN,
    methods: Sequence[str] = (),
    again: bool = False,
) -> list[ResultRow]:
    """Train and evaluate the cells without a row in `results`; returns the rows of all cells.

    Args:
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        results: file of JSON lines.
        budget: size of the benchmark.
        name: name of the budget, for the rows.
        workers: number of processes, of one thread each.
        table: a key of `TABLES`.
        methods: rows of the table; empty for all.
        again: as of `run_grid`.

    Raises:
        InputError: a file is missing, a method is not in the table, `results` has other content,
            or cells failed.
    """
    selected = chosen(TABLES[table], methods, "method")
    cells = cells_of(data, folder, budget, name, table, selected)
    return run_cells(cells, SCORE_MEASUREMENT, results, workers, f"benchmark {table}", again)


def cells_of(
    data: Path, folder: Path, budget: Budget, name: str, table: str, methods: Sequence[str]
) -> Iterator[Cell]:
    """The cells of some rows of a table; arguments as of `benchmark`."""
    # A method of two tables shares one run: trained once, evaluated for the rows of both.
    runs = folder / name
    for file in budget.files_in(data):
        store = zoo_store(data, stores_of(folder), file)
        for method in methods:
            learner, method_settings = TABLES[table][method]
            settings = (*method_settings, *budget.of_methods.get(method, ()))
            for seed in range(budget.seeds_of(file, method)):
                yield Cell(
                    suite=SCORES,
                    table=table,
                    budget=name,
                    file=file,
                    method=method,
                    learner=learner,
                    settings=settings_of(budget, name, learner, settings),
                    store=store,
                    run=runs / file / f"{method}-{seed}",
                    seed=seed,
                    episodes=budget.episodes,
                    evaluation_seed=budget.evaluation_seed,
                    rl=rl_settings_of(budget, name, learner),
                    all_targets=budget.all_targets,
                    shared=stages_of(folder),
                )
