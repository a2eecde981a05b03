"""Options shared by the benchmark commands of `ucfrec` and `ucfrec-control`."""

import argparse
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from ucfrec.errors import InputError, damage_explained
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import latest, read_rows


def grid_options(parser: argparse.ArgumentParser, out: str, workers: int) -> None:
    """Add --out, --results, --workers, --again and --show-only.

    Args:
        out: default of --out.
        workers: default of --workers.
    """
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


def seed_given(text: str) -> int:
    """The value of an option for a seed.

    Raises:
        ArgumentTypeError: `text` is no whole number from 0 to 2**32 − 1.
    """
    if not text.isdecimal() or len(text) > 10 or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"{text:.40} is no whole number from 0 to {2**32 - 1}")
    return int(text)


def evaluation_seed_option(parser: argparse.ArgumentParser) -> None:
    """Add --evaluation-seed."""
    parser.add_argument(
        "--evaluation-seed",
        type=seed_given,
        metavar="SEED",
        help="seed of the evaluated episodes, the same for every training seed (default: set by "
        "--budget)",
    )


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
        suite: benchmark suite of the rows.
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
