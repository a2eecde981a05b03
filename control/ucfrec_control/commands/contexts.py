"""`ucfrec-control contexts`: which context each method scores best with; resumes."""

import argparse
from collections.abc import Sequence

from ucfrec.benchmark.tables import over_seeds
from ucfrec.commands.grid_options import results_given, rows_explained
from ucfrec.reporting.tables import format_rows
from ucfrec.results.row import ResultRow
from ucfrec.results.statistics import grouped, summary
from ucfrec_control.benchmark.measure import CONTEXT, SCORE_MEASUREMENT
from ucfrec_control.benchmark.methods import CONTEXTS
from ucfrec_control.benchmark.plan import context_cells
from ucfrec_control.commands.options import (
    control_grid_options,
    data_option,
    rows_of_suite,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `contexts`."""
    data_option(parser)
    control_grid_options(parser)
    parser.set_defaults(budget="medium", rates=None, contexts=[])


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control contexts`."""
    rows = rows_of_suite(options, CONTEXTS, SCORE_MEASUREMENT, context_cells)
    with rows_explained(options):
        last = [row for row in rows if row.checkpoint == "last"]
        by, values = ("task", "method", CONTEXT), ("score", "validation_loss")
        print(format_rows(over_seeds([row.as_line() for row in last], by, values), (*by, *values)))
        print(f"\nhighest mean score: {' '.join(_chosen(last))}\nrows: {results_given(options)}")


def _chosen(rows: Sequence[ResultRow]) -> list[str]:
    """The option `--context` for each method: the context with the highest mean over files."""
    found = []
    for method, own in grouped(rows, lambda row: row.method).items():
        means = {
            context: summary(row.value for row in each).mean
            for context, each in grouped(own, lambda row: row.conditions[CONTEXT]).items()
        }
        found.append(f"--context {method}={max(means, key=lambda context: means[context])}")
    return found
