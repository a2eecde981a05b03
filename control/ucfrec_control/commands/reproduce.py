"""`ucfrec-control reproduce`: one table or figure of the paper; resumes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final

from ucfrec.benchmark.cells import PAPER_UCF, Budget, Cell
from ucfrec.commands.options import ARGUMENT, Names
from ucfrec.errors import InputError
from ucfrec.results.rows import ResultRow, benchmarking, latest, read_rows
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.measure import ROBUSTNESS_MEASUREMENT, SCORE_MEASUREMENT
from ucfrec_control.benchmark.methods import MAIN, PAPER_ABLATIONS, ROBUSTNESS, SCORES
from ucfrec_control.benchmark.plan import robustness_cells, score_cells
from ucfrec_control.commands.benchmark import print_scores
from ucfrec_control.commands.options import ControlGridOptions
from ucfrec_control.commands.robustness import print_robustness
from ucfrec_control.data.distractor import CLEAN


@dataclass(frozen=True)
class Part:
    """A table or figure of the paper."""

    table: str
    """A key of `TABLES`, or `ROBUSTNESS`."""
    methods: tuple[str, ...] = ()
    """Rows; empty for all of the table."""
    files: tuple[str, ...] = ()
    """Files; empty for those of the budget."""
    distractors: tuple[str, ...] = ()
    """Of `ROBUSTNESS`; empty for all."""
    of_runs: bool = False
    """Whether it is drawn of its runs, not of its rows."""

    def budget(self, name: str) -> Budget:
        """The budget `name` with the files of the part."""
        budget = budget_of(self.table, name)
        return replace(budget, tasks=self.files) if self.files else budget

    def cells(self, data: Path, folder: Path, budget: Budget) -> Iterator[Cell]:
        """The cells of the part, whose stores are written. InputError if a file is missing."""
        if self.table == ROBUSTNESS:
            return robustness_cells(data, folder, budget, self.methods, self.distractors)
        return score_cells(data, folder, budget, self.table, self.methods)

    def has(self, row: ResultRow) -> bool:
        """Whether a row is of the part."""
        table = row.suite if self.table == ROBUSTNESS else row.table
        chosen = (
            (self.methods, row.method),
            (self.files, row.task),
            (self.distractors, row.conditions.get("distractor")),
        )
        of_table = table == self.table and row.suite in (SCORES, ROBUSTNESS)
        return of_table and all(not names or name in names for names, name in chosen)


_BASELINES = ("dt", "dt-wo-time", "dc", "dc-wo-time", "lsdt", "lsdt-wo-time")
_DETERMINISTIC = (CLEAN, "deterministic")
_EVALUATED = ("dt-wo-time", "dc-wo-time", PAPER_UCF, "ucf", "ucf-dropped")
_BOTH = (PAPER_UCF, "ucf")
PARTS: Final[Mapping[str, Part]] = {
    "table-1": Part(MAIN, ("iql", "cql", *_BASELINES, *_BOTH)),
    "table-3": Part(
        MAIN, (PAPER_UCF, *PAPER_ABLATIONS, "ucf", "ucf-wo-count", "ucf-wo-arch", *_BASELINES)
    ),
    "table-9": Part("gate"),
    "table-10": Part("band"),
    "figure-2": Part("lambda"),
    "figure-3": Part(ROBUSTNESS, _EVALUATED, distractors=_DETERMINISTIC),
    "figure-4": Part(ROBUSTNESS, _EVALUATED, distractors=(*_DETERMINISTIC, "stochastic")),
    "figure-5": Part(MAIN, _BOTH, ("hopper_medium-zoo",), of_runs=True),
    "figure-6": Part(MAIN, _BOTH, ("halfcheetah_medium-zoo",), of_runs=True),
}
"""By name. Each has rows with the paper's settings and generator beside those of `ucf`, whose moves
are drawn from the band. Table 2 is `ucfrec benchmark recommendation`, tables 4 to 8 are settings,
and figure 1 is a diagram of the method."""


class Reproduce(ControlGridOptions):
    """`ucfrec-control reproduce`."""

    part: Annotated[str, ARGUMENT, Names(lambda: tuple(PARTS), closed=True)]
    """Table or figure of the paper."""

    def execute(self) -> None:
        """Run `ucfrec-control reproduce`."""
        # matplotlib takes half a second to import
        from ucfrec_control.figures.figures import draw_plans, make_figures, plan_rows

        part, results = PARTS[self.part], self.rows_file
        if self.show_only and part.of_runs:
            raise InputError(f"{self.part} is drawn from its runs; leave --show-only out")
        robust = part.table == ROBUSTNESS
        budget = self.narrow_budget(part.budget(self.budget))
        cells: list[Cell] = []
        if self.show_only:
            last = latest(read_rows(results))
            of_budget = [row for row in last if row.conditions.get("budget") == self.budget]
            rows = [row for row in of_budget if part.has(row)]
            if not rows:
                raise InputError(
                    f"{results} has no rows of {self.part} with budget {self.budget}; name a "
                    "file that has them with --results"
                )
        else:
            cells += part.cells(self.require_data(), self.out, budget)
            how = ROBUSTNESS_MEASUREMENT if robust else SCORE_MEASUREMENT
            with benchmarking(results):
                rows = self.measure(cells, how, f"reproduce {self.part}")
        pictures = self.out / self.part
        with self.explain_rows():
            if robust:
                print_robustness(rows)
            else:
                print_scores(rows, part.table)
            if part.of_runs:
                runs = [c.run for c in cells if c.run is not None and c.training_seed == 0]
                files, _ = make_figures(runs, [], pictures)
            else:
                files, _ = draw_plans(plan_rows(rows), pictures)
        print("\n".join(["", *map(str, files)]))
        print(f"\nrows: {results}")
