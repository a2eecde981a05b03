"""`ucfrec-control screen-all`: screening of every zoo file, plain and with distractors; resumes."""

import argparse
from collections.abc import Iterator

from ucfrec.benchmark.cells import Cell
from ucfrec.commands.grid_options import results_given, rows_explained, rows_of
from ucfrec.reporting.tables import format_rows
from ucfrec_control.benchmark.budgets import ZOO
from ucfrec_control.benchmark.plan import stores_of
from ucfrec_control.benchmark.robustness import (
    SCREENING,
    SCREENING_MEASUREMENT,
    SHOWN_SCREENING,
    screening_cells,
    screening_rows,
)
from ucfrec_control.commands.options import control_grid_options, data_given, data_option


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `screen-all`."""
    data_option(parser)
    control_grid_options(parser, budget=False)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control screen-all`."""

    def cells() -> Iterator[Cell]:
        return screening_cells(data_given(options), stores_of(options.out), ZOO)

    rows = rows_of(options, SCREENING, (), cells, SCREENING_MEASUREMENT)
    with rows_explained(options):
        print(format_rows(screening_rows(rows), SHOWN_SCREENING))
    print(f"\nrows: {results_given(options)}")
