"""`ucfrec-control robustness`: scores lost to distractors; resumes."""

import argparse
from collections.abc import Sequence

from ucfrec.commands.grid_options import results_given, rows_explained, rows_given
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import benchmarking
from ucfrec.reporting.tables import format_rows
from ucfrec_control.benchmark.cells import ROBUSTNESS
from ucfrec_control.benchmark.robustness import BUDGETS as ROBUSTNESS_BUDGETS
from ucfrec_control.benchmark.robustness import SHOWN as SHOWN_DROPS
from ucfrec_control.benchmark.robustness import (
    SHOWN_LARGEST,
    SHOWN_LOSSES,
    drops,
    largest_drops,
    loss_rises,
    robustness,
)
from ucfrec_control.benchmark.screening_table import SHOWN as SHOWN_SCREENING
from ucfrec_control.benchmark.screening_table import screening_rows
from ucfrec_control.benchmark.tables import over_seeds
from ucfrec_control.commands.options import (
    budget_given,
    budget_options,
    control_grid_options,
    data_given,
    data_option,
    rates_option,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `robustness`."""
    data_option(parser)
    budget_options(parser)
    rates_option(parser)
    control_grid_options(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control robustness`."""
    if options.show_only:
        rows = rows_given(options, ROBUSTNESS)
    else:
        with benchmarking(results_given(options)):
            rows = robustness(
                data_given(options),
                options.out,
                results_given(options),
                budget_given(ROBUSTNESS_BUDGETS, options),
                options.budget,
                options.workers,
                options.method,
                options.again,
            )
    with rows_explained(options):
        print_robustness(rows)
    print(f"\nrows: {results_given(options)}")


def print_robustness(rows: Sequence[ResultRow]) -> None:
    """Print what distractors cost, and what screening found."""
    by = ("task", "distractor", "method")
    for lines, values in ((drops(rows), SHOWN_DROPS), (loss_rises(rows), SHOWN_LOSSES)):
        print(f"{format_rows(over_seeds(lines, by, values), (*by, *values))}\n")
    print("largest loss of a method over datasets and distractors, % of the clean score")
    print(f"{format_rows(largest_drops(rows), SHOWN_LARGEST)}\n")
    # A store is screened once, whatever method and seed it is for.
    screened = {(line["task"], line["distractor"]): line for line in screening_rows(rows)}
    shown = [name for name in SHOWN_SCREENING if name != "training_seed"]
    print(format_rows(list(screened.values()), shown))
