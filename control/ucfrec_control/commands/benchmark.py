"""`ucfrec-control benchmark`: every method on the zoo files; resumes."""

from collections.abc import Sequence
from typing import Annotated

from ucfrec.benchmark.tables import difference_table, note_updates, score_table
from ucfrec.commands.options import Names
from ucfrec.reporting.tables import format_rows
from ucfrec.results.rows import ResultRow
from ucfrec_control.benchmark.measure import SCORE_MEASUREMENT
from ucfrec_control.benchmark.methods import MAIN, SCORES, TABLES
from ucfrec_control.benchmark.plan import chosen_rates, score_cells
from ucfrec_control.benchmark.seeds import average_seeds, select_best_target
from ucfrec_control.commands.options import SuiteOptions
from ucfrec_control.training.evaluate import CHECKPOINTS

UCF = "ucf"
"""The method of the main table that the others are compared with."""
_SHOWN = (
    *("task", "method", "training_seed", "checkpoint", "target_return", "score", "return"),
    *("episodes", "validation_loss"),
)


class Benchmark(SuiteOptions):
    """`ucfrec-control benchmark`."""

    table: Annotated[str, Names(lambda: tuple(TABLES), closed=True)] = MAIN
    """Every method (main), learning from the best quarter of the trajectories (pursuing), all
    trained for as long as DT or LSDT (equal-time), or a sweep over UCF's settings"""

    def execute(self) -> None:
        """Run `ucfrec-control benchmark`."""
        table = self.table
        rows = self.make_suite_rows(
            SCORES,
            table,
            SCORE_MEASUREMENT,
            lambda data, out, budget, methods: score_cells(data, out, budget, table, methods),
            f"benchmark {table}",
        )
        with self.explain_rows():
            print_scores(rows, table)
        print(f"\nrows: {self.rows_file}")


def print_scores(rows: Sequence[ResultRow], table: str) -> None:
    """Print the tables of rows of a benchmark, and how learning rates were chosen."""
    _print_tables(rows, table)
    for note in note_updates(rows):
        print(f"\n{note}")
    for budget in dict.fromkeys(str(row.conditions["budget"]) for row in rows):
        rates = ", ".join(f"{method} {rate:g}" for method, rate in chosen_rates(budget).items())
        default = "not searched: the budget's, over the presets"
        choice = f"chosen on validation loss: {rates}" if rates else default
        print(f"\nlearning rates of budget {budget}, {choice}")


def _print_tables(rows: Sequence[ResultRow], table: str) -> None:
    print(format_rows([dict.fromkeys(_SHOWN) | row.as_line() for row in rows], _SHOWN))
    if len(rows) > len(rows := select_best_target(rows)):
        print("\nbelow: of several target returns the best in the mean over seeds, as papers do")
    for checkpoint in CHECKPOINTS:
        if lines := score_table(rows, checkpoint):
            legend = "mean ± standard error over seeds; bold: within 5% of the best"
            print(f"\nscores of the {checkpoint} checkpoint, {legend}")
            print(format_rows(lines, list(lines[0])))
    last = [row for row in rows if row.checkpoint == "last"]
    by, values = ("task", "method"), ("score", "validation_loss")
    columns = (*values, "acceptance")
    print("\nlast checkpoint, mean ± standard deviation over seeds")
    print(format_rows(average_seeds([row.as_line() for row in last], by, columns), (*by, *columns)))
    reference = UCF if table == MAIN or not last else last[0].method
    for name in values:
        if lines := difference_table(last, reference, name):
            print(f"\n{name} less that of {reference} of the same seed, mean ± standard error")
            print(format_rows(lines, list(lines[0])))
