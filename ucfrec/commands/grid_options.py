"""Options shared by the benchmark commands of `ucfrec` and `ucfrec-control`."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ucfrec.benchmark.grid import run_grid
from ucfrec.errors import InputError, damage_explained
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import benchmarking, latest, read_rows

if TYPE_CHECKING:
    from ucfrec.benchmark.cells import Cell
    from ucfrec.benchmark.grid import Measurement


BUDGETS: Final = {
    "small": "for two CPU cores",
    "full": "larger logs, more seeds and training steps",
}
"""What the budgets of benchmarks are, by name."""


def grid_options(parser: argparse.ArgumentParser, out: str, workers: int) -> None:
    """Add --out, --results, --workers, --again and --show-only."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(out),
        help=f"folder for logs, stores, runs and result rows; resumed (default: {out})",
    )
    parser.add_argument(
        "--results",
        type=Path,
        metavar="JSONL",
        help="file of result rows: measured cells are read from it, new ones appended to it "
        "(default: results.jsonl in --out)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=workers,
        help=f"parallel processes, one thread each (default: {workers})",
    )
    parser.add_argument(
        "--again",
        action="store_true",
        help="remove the rows and runs of the chosen cells first; resume without it",
    )
    parser.add_argument(
        "--show-only",
        action="store_true",
        help="print the tables from the rows in --results without measuring anything",
    )


def budget_options(
    parser: argparse.ArgumentParser,
    task: str = "--task",
    seeds: str = "--training-seeds",
    budgets: Mapping[str, str] = BUDGETS,
) -> None:
    """Add the options that select what a benchmark measures, and how much of it.

    Args:
        task: name of the option for tasks, kept as `tasks`.
        seeds: name of the option for the number of training seeds, kept as `training_seeds`.
        budgets: what each budget is, by name; the first is the default.
    """
    parser.add_argument(
        "--budget",
        choices=list(budgets),
        default=next(iter(budgets)),
        help=f"{', '.join(f'{name} ({what})' for name, what in budgets.items())} "
        "(default: %(default)s)",
    )
    for name, kept in ((task, "tasks"), ("--method", "methods")):
        parser.add_argument(
            name,
            dest=kept,
            action="append",
            default=[],
            metavar="NAME",
            help=f"measure only this {name.removeprefix('--')}; repeatable (default: all of the "
            "budget)",
        )
    parser.add_argument(
        seeds,
        dest="training_seeds",
        type=int,
        metavar="N",
        help="training seeds of every method, from 0 (default: set by --budget)",
    )
    parser.add_argument(
        "--evaluation-seed",
        type=seed_given,
        metavar="SEED",
        help="seed of the evaluated episodes, the same for every training seed (default: set by "
        "--budget)",
    )


def seed_given(text: str) -> int:
    """The value of an option for a seed.

    Raises:
        ArgumentTypeError: `text` is not a whole number from 0 to 2**32 − 1.
    """
    if not text.isdecimal() or len(text) > 10 or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"{text:.40} is not a whole number from 0 to {2**32 - 1}")
    return int(text)


def results_given(options: argparse.Namespace) -> Path:
    """Path of the file of result rows: --results, or `results.jsonl` in --out."""
    given: Path = options.results or options.out / "results.jsonl"
    return given


def rows_explained(options: argparse.Namespace) -> AbstractContextManager[None]:
    """For the block that prints rows of --results: with --show-only, an `InputError` says what they
    lack. Rows that were just measured lack nothing: there an error is ours, and keeps its trace."""
    if not options.show_only:
        return nullcontext()
    remedy = "measure its rows again, or name another file with --results"
    return damage_explained(results_given(options), remedy)


def rows_given(
    options: argparse.Namespace, suite: str, tables: Sequence[str] = ()
) -> list[ResultRow]:
    """The rows that `--show-only` prints: the last of each measurement.

    Args:
        tables: tables of the suite; empty for all.

    Raises:
        InputError: the file has no such row, or a line of it is not a result row.
    """
    path = results_given(options)
    of_suite = [row for row in latest(read_rows(path)) if row.suite == suite]
    if rows := [row for row in of_suite if not tables or row.table in tables]:
        return rows
    wanted = ", ".join([suite, *tables])
    raise InputError(f"{path} has no rows of {wanted}; name a file that has them with --results")


def rows_of(
    options: argparse.Namespace,
    suite: str,
    tables: Sequence[str],
    cells: "Callable[[], Iterable[Cell]]",
    how: "Measurement[Cell]",
    describe: str = "",
) -> list[ResultRow]:
    """The rows that a command shows: with --show-only those of --results, else those of `cells`,
    which are measured where they have none.

    Args:
        options: of `grid_options`.
        tables: tables of the suite; empty for all.
        cells: lists what to measure; writes the stores that it needs.
        describe: name of the benchmark in progress output; "" for `suite`.

    Raises:
        InputError: as `rows_given`, as `cells`, or as `run_grid`.
    """
    if options.show_only:
        return rows_given(options, suite, tables)
    results = results_given(options)
    with benchmarking(results):
        return run_grid(
            list(cells()), how, results, options.workers, describe or suite, again=options.again
        )
