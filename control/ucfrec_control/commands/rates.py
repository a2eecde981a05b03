"""`ucfrec-control rates`: learning rates of all learners, by validation loss; resumes."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from ucfrec.commands.grid_options import results_given, rows_explained, rows_given
from ucfrec.reporting.result_row import ResultRow
from ucfrec.reporting.rows_file import benchmarking
from ucfrec.reporting.statistics import grouped
from ucfrec.reporting.tables import format_rows
from ucfrec_control.benchmark.budgets import SEARCHES
from ucfrec_control.benchmark.rates import (
    RATE,
    SUITE,
    best_rates,
    format_rates,
    search_rates,
    write_rates,
)
from ucfrec_control.benchmark.tables import over_seeds
from ucfrec_control.commands.options import (
    budget_given,
    budget_options,
    control_grid_options,
    data_given,
    data_option,
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `rates`."""
    data_option(parser)
    budget_options(parser)
    parser.add_argument("--steps", type=int, help="updates of a training (the budget's)")
    parser.add_argument("--toml", type=Path, metavar="FILE", help="write the choice here")
    control_grid_options(parser)
    parser.set_defaults(rates=None)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control rates`."""
    if options.show_only:
        with rows_explained(options):
            rows = _longest(rows_given(options, SUITE), options.budget)
    else:
        with benchmarking(results_given(options)):
            rows = search_rates(
                data_given(options),
                options.out,
                results_given(options),
                budget_given(SEARCHES, options),
                options.budget,
                options.workers,
                options.method,
                options.steps,
                options.again,
            )
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
