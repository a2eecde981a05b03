"""`ucfrec-control robustness`: scores lost to distractors; resumes."""

from collections.abc import Sequence

from ucfrec.benchmark.tables import note_updates
from ucfrec.reporting.tables import format_rows
from ucfrec.results.rows import ResultRow
from ucfrec_control.benchmark.measure import ROBUSTNESS_MEASUREMENT
from ucfrec_control.benchmark.methods import ROBUSTNESS
from ucfrec_control.benchmark.plan import robustness_cells
from ucfrec_control.benchmark.robustness import (
    SHOWN,
    SHOWN_LARGEST,
    SHOWN_SCREENING,
    drops,
    largest_drops,
    screening_rows,
)
from ucfrec_control.benchmark.seeds import average_seeds
from ucfrec_control.commands.options import SuiteOptions


class Robustness(SuiteOptions):
    """`ucfrec-control robustness`."""

    def execute(self) -> None:
        """Run `ucfrec-control robustness`."""
        rows = self.make_suite_rows(ROBUSTNESS, "", ROBUSTNESS_MEASUREMENT, robustness_cells)
        with self.explain_rows():
            print_robustness(rows)
        print(f"\nrows: {self.rows_file}")


def print_robustness(rows: Sequence[ResultRow]) -> None:
    """Print what distractors cost, and what screening found."""
    by = ("task", "distractor", "method")
    print(f"{format_rows(average_seeds(drops(rows), by, SHOWN), (*by, *SHOWN))}\n")
    print("largest loss of a method over datasets and distractors, % of the clean score")
    print(f"{format_rows(largest_drops(rows), SHOWN_LARGEST)}\n")
    # A store is screened once, whatever method and seed it is for.
    screened = {(line["task"], line["distractor"]): line for line in screening_rows(rows)}
    print(format_rows(list(screened.values()), SHOWN_SCREENING))
    for note in note_updates(rows):
        print(f"\n{note}")
