"""`ucfrec-control reproduce`: one table or figure of the paper; resumes."""

from typing import Annotated

from ucfrec.benchmark.cells import Cell
from ucfrec.commands.options import ARGUMENT, Names
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
from ucfrec_control.commands.options import ControlGridOptions
from ucfrec_control.commands.robustness import print_robustness


class Reproduce(ControlGridOptions):
    """`ucfrec-control reproduce`."""

    part: Annotated[str, ARGUMENT, Names(lambda: tuple(PARTS), closed=True)]
    """Table or figure of the paper."""

    def execute(self) -> None:
        """Run `ucfrec-control reproduce`."""
        # matplotlib takes half a second to import
        from ucfrec_control.figures.figures import make_figures, make_row_figures

        part, results = PARTS[self.part], self.rows_file
        if self.show_only and part.of_runs:
            raise InputError(f"{self.part} is drawn from its runs; leave --show-only out")
        robust = part.table == ROBUSTNESS
        budget = self.narrow_budget(budget_of_part(part, self.budget))
        cells: list[Cell] = []
        if self.show_only:
            rows = rows_of_part(part, latest(read_rows(results)), self.budget)
            if not rows:
                raise InputError(
                    f"{results} has no rows of {self.part} with budget {self.budget}; name a "
                    "file that has them with --results"
                )
        else:
            cells += cells_of_part(part, self.require_data(), self.out, budget)
            how = ROBUSTNESS_MEASUREMENT if robust else SCORE_MEASUREMENT
            rows = self.make_rows("", (), lambda: cells, how, f"reproduce {self.part}")
        pictures = self.out / self.part
        with self.explain_rows():
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
