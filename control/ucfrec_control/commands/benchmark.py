"""`ucfrec-control benchmark`: every method on the zoo files; resumes."""

import argparse
from collections.abc import Sequence

from ucfrec.benchmark.tables import difference_table, of_best_target, over_seeds, score_table
from ucfrec.commands.grid_options import results_given, rows_explained, rows_of
from ucfrec.commands.options import option
from ucfrec.reporting.tables import format_rows
from ucfrec.results.row import ResultRow
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.measure import SCORE_MEASUREMENT
from ucfrec_control.benchmark.methods import MAIN, SCORES, TABLES
from ucfrec_control.benchmark.plan import chosen_rates, score_cells
from ucfrec_control.commands.options import control_grid_options, list_cells
from ucfrec_control.training.evaluate import CHECKPOINTS

UCF = "ucf"
"""The method of the main table that the others are compared with."""
_SHOWN = (
    *("task", "method", "training_seed", "checkpoint", "target_return", "score", "return"),
    *("episodes", "validation_loss"),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `benchmark`."""
    text = (
        "every method (main), ways to pursue reward, all trained for as long as DT or LSDT "
        "(equal-time), or a sweep over UCF's settings"
    )
    option(parser, "--table", list(TABLES), text, default=MAIN)
    control_grid_options(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control benchmark`."""
    table, budget = options.table, budget_of(options.table, options.budget)
    rows = rows_of(
        options,
        SCORES,
        [table],
        lambda: list_cells(
            options,
            budget,
            lambda data, own: score_cells(data, options.out, own, table, options.methods),
        ),
        SCORE_MEASUREMENT,
        f"benchmark {table}",
    )
    with rows_explained(options):
        print_scores(rows, table)
    print(f"\nrows: {results_given(options)}")


def print_scores(rows: Sequence[ResultRow], table: str) -> None:
    """Print the tables of rows of a benchmark, and how learning rates were chosen."""
    _print_tables(rows, table)
    for budget in dict.fromkeys(str(row.conditions["budget"]) for row in rows):
        rates = ", ".join(f"{method} {rate:g}" for method, rate in chosen_rates(budget).items())
        choice = (
            f"chosen on validation loss: {rates}"
            if rates
            else "not searched: the budget's, over the presets"
        )
        print(f"\nlearning rates of budget {budget}, {choice}")


def _print_tables(rows: Sequence[ResultRow], table: str) -> None:
    print(format_rows([dict.fromkeys(_SHOWN) | row.as_line() for row in rows], _SHOWN))
    if len(rows) > len(rows := of_best_target(rows)):
        print("\nbelow: of several target returns the best in the mean over seeds, as papers do")
    for checkpoint in CHECKPOINTS:
        if lines := score_table(rows, checkpoint):
            print(
                f"\nscores of the {checkpoint} checkpoint, mean ± standard error over seeds; bold: "
                "within 5% of the best"
            )
            print(format_rows(lines, list(lines[0])))
    last = [row for row in rows if row.checkpoint == "last"]
    by, values = ("task", "method"), ("score", "validation_loss")
    columns = (*values, "acceptance")
    print("\nlast checkpoint, mean ± standard deviation over seeds")
    print(format_rows(over_seeds([row.as_line() for row in last], by, columns), (*by, *columns)))
    reference = UCF if table == MAIN or not last else last[0].method
    for name in values:
        if lines := difference_table(last, reference, name):
            print(f"\n{name} less that of {reference} of the same seed, mean ± standard error")
            print(format_rows(lines, list(lines[0])))
