"""`ucfrec-control rates`: learning rates of sequence policies, by validation loss; resumes."""

import argparse
from pathlib import Path

from ucfrec.commands.grid_options import results_given, rows_given
from ucfrec.files import atomic_file
from ucfrec.reporting.rows_file import benchmarking
from ucfrec.reporting.tables import format_rows
from ucfrec_control.benchmark.budgets import BUDGETS
from ucfrec_control.benchmark.rates import RATE, SUITE, best_rates, search_rates
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


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control rates`."""
    if options.show_only:
        rows = rows_given(options, SUITE)
        rows = [row for row in rows if row.conditions["budget"] == options.budget]
    else:
        with benchmarking(results_given(options)):
            rows = search_rates(
                data_given(options),
                options.out,
                results_given(options),
                budget_given(BUDGETS, options),
                options.budget,
                options.workers,
                options.method,
                options.steps,
            )
    by, values = ("task", "method", RATE), ("validation_loss",)
    print(format_rows(over_seeds([row.as_line() for row in rows], by, values), (*by, *values)))
    lines = [f"[{options.budget}]", *(f"{m} = {rate:g}" for m, rate in best_rates(rows).items())]
    text = "\n".join(lines)
    print(f"\n{text}\n\nrows: {results_given(options)}")
    if options.toml is not None:
        with atomic_file(options.toml) as scratch:
            scratch.write_text(f"{text}\n", encoding="utf-8")
