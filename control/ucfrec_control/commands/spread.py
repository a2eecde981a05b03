"""`ucfrec-control spread`: scores of single checkpoints, with raw and averaged weights; resumes."""

import argparse
from collections.abc import Iterator

from ucfrec.benchmark.cells import Cell
from ucfrec.commands.grid_options import results_given, rows_explained, rows_of
from ucfrec.reporting.tables import format_rows
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.costs import costs
from ucfrec_control.benchmark.measure import SPREAD_MEASUREMENT
from ucfrec_control.benchmark.methods import SPREAD
from ucfrec_control.benchmark.plan import spread_cells
from ucfrec_control.benchmark.spread import SHOWN, spreads
from ucfrec_control.commands.options import (
    choices_options,
    control_grid_options,
    data_given,
    data_option,
    narrowed,
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
    budget = narrowed(budget_of(SPREAD, options.budget), options)

    def cells() -> Iterator[Cell]:
        given = data_given(options), options.out, budget
        return spread_cells(*given, options.methods, options.checkpoints)

    rows = rows_of(options, SPREAD, (), cells, SPREAD_MEASUREMENT, costs)
    with rows_explained(options):
        print(format_rows(spreads(rows), SHOWN))
    print(f"\nrows: {results_given(options)}")
