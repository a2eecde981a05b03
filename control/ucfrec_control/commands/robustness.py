"""`ucfrec-control robustness`: scores lost to distractors; resumes."""

import argparse
from collections.abc import Iterator, Sequence

from ucfrec.benchmark.cells import Cell
from ucfrec.benchmark.tables import over_seeds
from ucfrec.commands.grid_options import results_given, rows_explained, rows_of
from ucfrec.reporting.tables import format_rows
from ucfrec.results.row import ResultRow
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.costs import costs
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
from ucfrec_control.commands.options import (
    choices_options,
    control_grid_options,
    data_given,
    data_option,
    narrowed,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `robustness`."""
    data_option(parser)
    choices_options(parser)
    control_grid_options(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control robustness`."""
    budget = narrowed(budget_of(ROBUSTNESS, options.budget), options)

    def cells() -> Iterator[Cell]:
        return robustness_cells(data_given(options), options.out, budget, options.methods)

    rows = rows_of(options, ROBUSTNESS, (), cells, ROBUSTNESS_MEASUREMENT, costs)
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
    shown = [name for name in SHOWN_SCREENING if name != "training_seed"]
    print(format_rows(list(screened.values()), shown))
