"""Options that every benchmark takes, of `ucfrec` and of `ucfrec-control`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from ucfrec.errors import InputError
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import latest, read_rows


def grid_options(parser: argparse.ArgumentParser, out: str, workers: int) -> None:
    """Where a benchmark keeps what it makes, and how it is run.

    Args:
        out: the folder where none is given.
        workers: as many processes where no number is given.
    """
    parser.add_argument(
        "--out", type=Path, default=Path(out), help=f"logs, stores, runs and rows ({out})"
    )
    parser.add_argument(
        "--results",
        type=Path,
        metavar="JSONL",
        help="result rows; read, and appended to (results.jsonl in --out)",
    )
    parser.add_argument(
        "--workers", type=int, default=workers, help=f"processes of one thread each ({workers})"
    )
    parser.add_argument(
        "--show-only",
        action="store_true",
        help="print the tables of the rows in --results; measure nothing",
    )


def evaluation_seed_option(parser: argparse.ArgumentParser) -> None:
    """What episodes are reported."""
    parser.add_argument(
        "--evaluation-seed",
        type=int,
        metavar="SEED",
        help="of the reported episodes, the same for every training seed (the budget's)",
    )


def results_given(options: argparse.Namespace) -> Path:
    """The file of result rows."""
    given: Path = options.results or options.out / "results.jsonl"
    return given


def rows_given(
    options: argparse.Namespace, suite: str, tables: Sequence[str] = ()
) -> list[ResultRow]:
    """The rows that `--show-only` is about: of those that measure the same, the last.

    Args:
        tables: of the suite; empty for all.

    Raises:
        InputError: there are none, or the file holds something else.
    """
    path = results_given(options)
    own = [row for row in latest(read_rows(path)) if row.suite == suite]
    if rows := [row for row in own if not tables or row.table in tables]:
        return rows
    wanted = ", ".join([suite, *tables])
    raise InputError(f"{path} has no rows of {wanted}; name a file that has with --results")
