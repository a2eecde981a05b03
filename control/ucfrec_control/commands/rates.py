"""`ucfrec-control rates`: learning rates of all policies, by validation loss; resumes."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from ucfrec.benchmark.tables import over_seeds
from ucfrec.commands.grid_options import results_given, rows_explained
from ucfrec.reporting.tables import format_rows
from ucfrec.results.row import ResultRow
from ucfrec.results.statistics import grouped
from ucfrec_control.benchmark.measure import RATE, RATE_MEASUREMENT
from ucfrec_control.benchmark.methods import RATES
from ucfrec_control.benchmark.plan import rate_cells
from ucfrec_control.benchmark.rates import best_rates, format_rates, write_rates
from ucfrec_control.commands.options import (
    control_grid_options,
    data_option,
    rows_of_suite,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rates`."""
    data_option(parser)
    parser.add_argument("--steps", type=int, help="updates of a training (the budget's)")
    parser.add_argument("--toml", type=Path, metavar="FILE", help="write the choice here")
    control_grid_options(parser)
    parser.set_defaults(rates=None, contexts=[])


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control rates`."""
    rows = rows_of_suite(options, RATES, RATE_MEASUREMENT, rate_cells, options.steps)
    if options.show_only:
        with rows_explained(options):
            rows = _longest(rows, options.budget)
    by, values = ("task", "method", RATE), ("validation_loss",)
    with rows_explained(options):
        print(format_rows(over_seeds([row.as_line() for row in rows], by, values), (*by, *values)))
        found = best_rates(rows)
    print(f"\n{format_rates((options.budget, found))}\nrows: {results_given(options)}")
    if options.toml is not None:
        write_rates(options.toml, options.budget, found)


def _longest(rows: Sequence[ResultRow], budget: str) -> list[ResultRow]:
    """The rows of a budget; beside shorter trainings, which rehearse the search, only a method's
    longest count."""
    of_budget = [row for row in rows if row.conditions["budget"] == budget]
    return [
        row
        for own in grouped(of_budget, lambda row: row.method).values()
        for row in own
        if row.metrics["steps"] == max(each.metrics["steps"] for each in own)
    ]
