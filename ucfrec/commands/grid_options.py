"""Options shared by the benchmark commands of `ucfrec` and `ucfrec-control`."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ucfrec.benchmark.grid import run_grid
from ucfrec.commands.options import option
from ucfrec.errors import InputError, damage_explained
from ucfrec.results.rows import ResultRow, benchmarking, latest, read_rows

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
    text = "folder for logs, stores, runs and result rows; resumed"
    option(parser, "--out", Path, f"{text} (default: {out})", default=Path(out))
    option(
        parser,
        "--results",
        Path,
        "file of result rows; measured cells are read from it, new ones appended to it "
        "(default: results.jsonl in --out)",
        "JSONL",
    )
    option(parser, "--workers", workers, "parallel processes, one thread each")
    text = "remove the rows and runs of the chosen cells first; resume without it"
    option(parser, "--again", False, text)
    text = "print the tables from the rows in --results without measuring anything"
    option(parser, "--show-only", False, text)


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
    meanings = ", ".join(f"{name} ({meaning})" for name, meaning in budgets.items())
    text, first = f"{meanings} (default: %(default)s)", next(iter(budgets))
    option(parser, "--budget", list(budgets), text, default=first)
    for name, dest in ((task, "tasks"), ("--method", "methods")):
        text = f"measure only this {name.removeprefix('--')}; repeatable (default: all of the"
        how: dict[str, Any] = {"dest": dest, "action": "append", "default": []}
        option(parser, name, str, f"{text} budget)", "NAME", **how)
    group = parser.add_argument_group("seeds")
    text = "training seeds of every method, from 0 (default: set by --budget)"
    option(group, seeds, int, text, "N", dest="training_seeds")
    option(
        group,
        "--evaluation-seed",
        seed_given,
        "seed of the evaluated episodes, the same for every training seed (default: set by "
        "--budget)",
        "SEED",
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
