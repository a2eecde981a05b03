"""`ucfrec-control robustness`: scores lost to distractors; resumes."""

import argparse
from collections.abc import Sequence

from ucfrec.benchmark.tables import over_seeds
from ucfrec.commands.grid_options import results_given, rows_explained, rows_of
from ucfrec.reporting.tables import format_rows
from ucfrec.results.row import ResultRow
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.measure import ROBUSTNESS_MEASUREMENT
from ucfrec_control.benchmark.methods import ROBUSTNESS
from ucfrec_control.benchmark.plan import robustness_cells
from ucfrec_control.benchmark.robustness import (
    SHOWN,
    SHOWN_LARGEST,
    SHOWN_LOSSES,
    SHOWN_SCREENING,
    drops,
    largest_drops,
    loss_rises,
    screening_rows,
)
from ucfrec_control.commands.options import control_grid_options, list_cells


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `robustness`."""
    control_grid_options(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control robustness`."""
    rows = rows_of(
        options,
        ROBUSTNESS,
        (),
        lambda: list_cells(
            options,
            budget_of(ROBUSTNESS, options.budget),
            lambda data, own: robustness_cells(data, options.out, own, options.methods),
        ),
        ROBUSTNESS_MEASUREMENT,
    )
    with rows_explained(options):
        print_robustness(rows)
    print(f"\nrows: {results_given(options)}")


def print_robustness(rows: Sequence[ResultRow]) -> None:
    """Print what distractors cost, and what screening found."""
    by = ("task", "distractor", "method")
    for lines, values in ((drops(rows), SHOWN), (loss_rises(rows), SHOWN_LOSSES)):
        print(f"{format_rows(over_seeds(lines, by, values), (*by, *values))}\n")
    print("largest loss of a method over datasets and distractors, % of the clean score")
    print(f"{format_rows(largest_drops(rows), SHOWN_LARGEST)}\n")
    # A store is screened once, whatever method and seed it is for.
    screened = {(line["task"], line["distractor"]): line for line in screening_rows(rows)}
    print(format_rows(list(screened.values()), SHOWN_SCREENING))
