"""`ucfrec-control robustness`: what distractors cost; resumes."""

import argparse

from ucfrec.provenance import format_rows
from ucfrec_control.benchmark.robustness import BUDGETS as ROBUSTNESS_BUDGETS
from ucfrec_control.benchmark.robustness import SHOWN as SHOWN_DROPS
from ucfrec_control.benchmark.robustness import SHOWN_LOSSES, drops, loss_rises, robustness
from ucfrec_control.benchmark.screening_table import SHOWN as SHOWN_SCREENING
from ucfrec_control.benchmark.screening_table import screening_rows
from ucfrec_control.benchmark.tables import over_seeds
from ucfrec_control.commands.options import budget_given, budget_options, grid_options


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `robustness` takes."""
    budget_options(parser)
    grid_options(parser, "control_robustness")


def run(options: argparse.Namespace) -> None:
    """`ucfrec-control robustness`."""
    rows = robustness(
        options.data,
        options.out,
        options.results,
        budget_given(ROBUSTNESS_BUDGETS, options),
        options.budget,
        options.workers,
        options.method,
    )
    by = ("dataset", "distractor", "method")
    for found, values in ((drops(rows), SHOWN_DROPS), (loss_rises(rows), SHOWN_LOSSES)):
        print(f"{format_rows(over_seeds(found, by, values), (*by, *values))}\n")
    print(f"{format_rows(screening_rows(rows), SHOWN_SCREENING)}\n\nrows: {options.results}")
