"""`ucfrec-control reproduce`: one table or figure of the paper; resumes."""

import argparse

from ucfrec.commands.grid_options import results_given, rows_explained
from ucfrec.errors import InputError
from ucfrec.reporting.rows_file import benchmarking, latest, read_rows
from ucfrec_control.benchmark.cells import (
    ROBUSTNESS,
    ROBUSTNESS_MEASUREMENT,
    SCORE_MEASUREMENT,
    Cell,
)
from ucfrec_control.benchmark.reproduce import PARTS, budget_of, cells_of_part, rows_of_part
from ucfrec_control.benchmark.robustness import BUDGETS as ROBUSTNESS_BUDGETS
from ucfrec_control.benchmark.run_cells import run_cells
from ucfrec_control.commands.benchmark import budgets_of, print_scores
from ucfrec_control.commands.options import (
    budget_given,
    control_grid_options,
    data_given,
    data_option,
    rates_option,
)
from ucfrec_control.commands.robustness import print_robustness


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `reproduce`."""
    parser.add_argument("part", choices=list(PARTS), help="table or figure of the paper")
    data_option(parser)
    parser.add_argument("--budget", default="small", choices=["small", "full"])
    parser.add_argument("--seeds", type=int, help="number of training seeds (the budget's)")
    rates_option(parser)
    control_grid_options(parser)
    parser.set_defaults(file=[], evaluation_seed=None)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control reproduce`."""
    # matplotlib takes half a second to import
    from ucfrec_control.figures.figures import make_figures, make_row_figures

    part, results = PARTS[options.part], results_given(options)
    if options.show_only and part.of_runs:
        raise InputError(f"{options.part} is drawn from its runs; leave --show-only out")
    robust = part.table == ROBUSTNESS
    known = ROBUSTNESS_BUDGETS if robust else budgets_of(part.table)
    budget = budget_of(part, budget_given(known, options))
    cells: list[Cell] = []
    if options.show_only:
        rows = rows_of_part(part, latest(read_rows(results)), options.budget)
        if not rows:
            raise InputError(
                f"{results} has no rows of {options.part} with budget {options.budget}; name a "
                "file that has them with --results"
            )
    else:
        cells += cells_of_part(part, data_given(options), options.out, budget, options.budget)
        with benchmarking(results):
            how = ROBUSTNESS_MEASUREMENT if robust else SCORE_MEASUREMENT
            said = f"reproduce {options.part}"
            rows = run_cells(cells, how, results, options.workers, said, options.again)
    pictures = options.out / options.part
    with rows_explained(options):
        if robust:
            print_robustness(rows)
        else:
            print_scores(rows, part.table, budget.rates)
        if part.of_runs:
            made, _ = make_figures([cell.run for cell in cells], [], pictures)
        else:
            made = make_row_figures(rows, pictures)
    print("\n".join(["", *map(str, made)]))
    print(f"\nrows: {results}")
