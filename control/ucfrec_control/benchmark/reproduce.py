"""What the paper's control tables and figures are made of."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from ucfrec.reporting.result_row import ResultRow
from ucfrec_control.benchmark.budgets import Budget
from ucfrec_control.benchmark.cells import ROBUSTNESS, SCORES, Cell
from ucfrec_control.benchmark.methods import MAIN, TABLES
from ucfrec_control.benchmark.plan import cells_of
from ucfrec_control.benchmark.robustness import robustness_cells
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


_BASELINES = ("dt", "dt-wo-time", "dc", "dc-wo-time", "lsdt", "lsdt-wo-time")
_DETERMINISTIC = (CLEAN, "deterministic")
_JUDGED = ("dt-wo-time", "dc-wo-time", "ucf", "ucf-dropped")
PARTS: Final[Mapping[str, Part]] = {
    "table-1": Part(MAIN, ("iql", "cql", *_BASELINES, "ucf-paper", "ucf")),
    "table-3": Part(MAIN, ("ucf", "ucf-wo-count", "ucf-wo-arch", *_BASELINES)),
    "table-9": Part("gate"),
    "table-10": Part("band"),
    "figure-2": Part("lambda"),
    "figure-3": Part(ROBUSTNESS, _JUDGED, distractors=_DETERMINISTIC),
    "figure-4": Part(ROBUSTNESS, _JUDGED, distractors=(*_DETERMINISTIC, "stochastic")),
    "figure-5": Part(MAIN, ("ucf",), ("hopper_medium-zoo",), of_runs=True),
    "figure-6": Part(MAIN, ("ucf",), ("halfcheetah_medium-zoo",), of_runs=True),
}
"""By name. Table 2 is `ucfrec benchmark recommendation`, tables 4 to 8 are settings, and figure 1
is a diagram of the method."""


def budget_of(part: Part, budget: Budget) -> Budget:
    """`budget` with the files of the part."""
    return replace(budget, files=part.files, where_present=()) if part.files else budget


def cells_of_part(
    part: Part, data: Path, folder: Path, budget: Budget, name: str
) -> Iterator[Cell]:
    """The cells of a part; writes the stores that they need.

    Args:
        part: of `PARTS`.
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        budget: of `budget_of`.
        name: its name.

    Raises:
        InputError: a file is missing.
    """
    if part.table == ROBUSTNESS:
        return robustness_cells(data, folder, budget, name, part.methods, part.distractors)
    methods = part.methods or tuple(TABLES[part.table])
    return cells_of(data, folder, budget, name, part.table, methods)


def rows_of_part(part: Part, rows: Sequence[ResultRow], name: str) -> list[ResultRow]:
    """The rows of a part.

    Args:
        part: of `PARTS`.
        rows: of any tables.
        name: of the budget.
    """
    return [row for row in rows if row.conditions.get("budget") == name and _is_of(part, row)]


def _is_of(part: Part, row: ResultRow) -> bool:
    if (part.methods and row.method not in part.methods) or (
        part.files and row.task not in part.files
    ):
        return False
    if part.table == ROBUSTNESS:
        distractor = row.conditions.get("distractor")
        return row.suite == ROBUSTNESS and (not part.distractors or distractor in part.distractors)
    return (row.suite, row.table) == (SCORES, part.table)
