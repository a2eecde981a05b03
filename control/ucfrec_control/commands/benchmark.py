"""`ucfrec-control benchmark`: every learner on the zoo files; resumes."""

import argparse
from pathlib import Path

from ucfrec.provenance import format_rows
from ucfrec_control.benchmark.plan import BUDGETS, MAIN, SWEEPS, benchmark
from ucfrec_control.benchmark.tables import against_first, over_seeds, score_table
from ucfrec_control.commands.options import budget_given, budget_options, grid_outputs, shown_score
from ucfrec_control.learners.evaluate import CHECKPOINTS, SHOWN


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `benchmark` takes."""
    parser.add_argument("data", type=Path, metavar="DATA", help="folder of the HDF5 files")
    parser.add_argument(
        "--table",
        default="main",
        choices=["main", "lambda", "gate", "band", "augmentation"],
        help="every learner (main), or a sweep over UCF's settings",
    )
    budget_options(parser)
    grid_outputs(parser, "control")


def run(options: argparse.Namespace) -> None:
    """`ucfrec-control benchmark`."""
    rows = benchmark(
        options.data,
        options.out,
        options.results,
        budget_given(BUDGETS if options.table == MAIN else SWEEPS, options),
        options.budget,
        options.workers,
        options.table,
        options.method,
    )
    print(format_rows([shown_score(row) for row in rows], SHOWN))
    for checkpoint in CHECKPOINTS:
        table = score_table(rows, checkpoint)
        print(f"\nscores of the {checkpoint} checkpoint, mean ± standard deviation over seeds")
        print(format_rows(table, list(table[0])))
    last = [row for row in rows if row["checkpoint"] == "last"]
    by, values = ("dataset", "method"), ("score", "validation_loss")
    shown = (*values, "acceptance")
    print("\nlast checkpoint, mean ± standard deviation over seeds")
    print(format_rows(over_seeds(last, by, shown), (*by, *shown)))
    if options.table != MAIN:
        print(f"\nless {last[0]['method']} of the same seed, mean ± standard error")
        print(format_rows(against_first(last, values), (*by, *values)))
    print(f"\nrows: {options.results}")
