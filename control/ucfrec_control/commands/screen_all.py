"""`ucfrec-control screen-all`: screening of every zoo file, plain and with distractors; resumes."""

import argparse

from ucfrec.commands.grid_options import results_given, rows_explained, rows_given
from ucfrec.reporting.rows_file import benchmarking
from ucfrec.reporting.tables import format_rows
from ucfrec_control.benchmark.budgets import BUDGETS
from ucfrec_control.benchmark.folders import stores_of
from ucfrec_control.benchmark.screening_table import SCREENING, screening_rows, screening_table
from ucfrec_control.benchmark.screening_table import SHOWN as SHOWN_SCREENING
from ucfrec_control.commands.options import control_grid_options, data_given, data_option


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `screen-all`."""
    data_option(parser)
    control_grid_options(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control screen-all`."""
    if options.show_only:
        rows = rows_given(options, SCREENING)
    else:
        with benchmarking(results_given(options)):
            files, stores = BUDGETS["full"].files, stores_of(options.out)
            given = data_given(options), stores, files, results_given(options)
            rows = screening_table(*given, options.workers, options.again)
    with rows_explained(options):
        print(format_rows(screening_rows(rows), SHOWN_SCREENING))
    print(f"\nrows: {results_given(options)}")
