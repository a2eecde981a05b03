"""`ucfrec-control reproduce`: one table or figure of the paper; resumes."""

import argparse

from ucfrec.benchmark.cells import Cell
from ucfrec.commands.grid_options import results_given, rows_explained, rows_of
from ucfrec.errors import InputError
from ucfrec.results.rows import latest, read_rows
from ucfrec_control.benchmark.measure import ROBUSTNESS_MEASUREMENT, SCORE_MEASUREMENT
from ucfrec_control.benchmark.methods import ROBUSTNESS
from ucfrec_control.benchmark.reproduce import (
    PARTS,
    budget_of_part,
    cells_of_part,
    rows_of_part,
)
from ucfrec_control.commands.benchmark import print_scores
from ucfrec_control.commands.options import (
    BUDGETS,
    context_option,
    control_grid_options,
    data_given,
    data_option,
    narrow_budget,
)
from ucfrec_control.commands.robustness import print_robustness


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `reproduce`."""
    parser.add_argument("part", choices=list(PARTS), help="table or figure of the paper")
    data_option(parser)
    parser.add_argument("--budget", default="small", choices=list(BUDGETS))
    parser.add_argument(
        "--seeds",
        dest="training_seeds",
        type=int,
        help="number of training seeds (default: set by --budget)",
    )
    context_option(parser)
    control_grid_options(parser, budget=False)
    parser.set_defaults(tasks=[], evaluation_seed=None)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control reproduce`."""
    # matplotlib takes half a second to import
    from ucfrec_control.figures.figures import make_figures, make_row_figures

    part, results = PARTS[options.part], results_given(options)
    if options.show_only and part.of_runs:
        raise InputError(f"{options.part} is drawn from its runs; leave --show-only out")
    robust = part.table == ROBUSTNESS
    budget = narrow_budget(budget_of_part(part, options.budget), options)
    cells: list[Cell] = []
    if options.show_only:
        rows = rows_of_part(part, latest(read_rows(results)), options.budget)
        if not rows:
            raise InputError(
                f"{results} has no rows of {options.part} with budget {options.budget}; name a "
                "file that has them with --results"
            )
    else:
        cells += cells_of_part(part, data_given(options), options.out, budget)
        how = ROBUSTNESS_MEASUREMENT if robust else SCORE_MEASUREMENT
        rows = rows_of(options, "", (), lambda: cells, how, f"reproduce {options.part}")
    pictures = options.out / options.part
    with rows_explained(options):
        if robust:
            print_robustness(rows)
        else:
            print_scores(rows, part.table)
        if part.of_runs:
            files, _ = make_figures(
                [cell.run for cell in cells if cell.run is not None], [], pictures
            )
        else:
            files = make_row_figures(rows, pictures)
    print("\n".join(["", *map(str, files)]))
    print(f"\nrows: {results}")
