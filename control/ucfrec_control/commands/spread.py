"""`ucfrec-control spread`: scores of single checkpoints, with raw and averaged weights; resumes."""

import argparse

from ucfrec.commands.grid_options import results_given, rows_explained
from ucfrec.reporting.tables import format_rows
from ucfrec_control.benchmark.measure import SPREAD_MEASUREMENT
from ucfrec_control.benchmark.methods import SPREAD
from ucfrec_control.benchmark.plan import spread_cells
from ucfrec_control.benchmark.spread import SHOWN, spreads
from ucfrec_control.commands.options import (
    choices_options,
    control_grid_options,
    data_option,
    rows_of_suite,
)
from ucfrec_control.training.kept import KEPT


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `spread`."""
    data_option(parser)
    parser.add_argument(
        "--checkpoints",
        type=int,
        default=KEPT,
        choices=range(1, KEPT + 1),
        help=f"number of last checkpoints of each training (default: {KEPT})",
    )
    choices_options(parser)
    control_grid_options(parser)
    parser.set_defaults(budget="medium")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control spread`."""
    rows = rows_of_suite(options, SPREAD, SPREAD_MEASUREMENT, spread_cells, options.checkpoints)
    with rows_explained(options):
        print(format_rows(spreads(rows), SHOWN))
    print(f"\nrows: {results_given(options)}")
