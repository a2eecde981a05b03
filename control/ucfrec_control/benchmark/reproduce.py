"""What the paper's control tables and figures are made of."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from ucfrec.benchmark.cells import Budget, Cell
from ucfrec.results.rows import ResultRow
from ucfrec_control.benchmark.budgets import budget_of
from ucfrec_control.benchmark.methods import MAIN, ROBUSTNESS, SCORES
from ucfrec_control.benchmark.plan import robustness_cells, score_cells
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
_EVALUATED = ("dt-wo-time", "dc-wo-time", "ucf", "ucf-dropped")
PARTS: Final[Mapping[str, Part]] = {
    "table-1": Part(MAIN, ("iql", "cql", *_BASELINES, "ucf-paper", "ucf")),
    "table-3": Part(MAIN, ("ucf", "ucf-wo-count", "ucf-wo-arch", *_BASELINES)),
    "table-9": Part("gate"),
    "table-10": Part("band"),
    "figure-2": Part("lambda"),
    "figure-3": Part(ROBUSTNESS, _EVALUATED, distractors=_DETERMINISTIC),
    "figure-4": Part(ROBUSTNESS, _EVALUATED, distractors=(*_DETERMINISTIC, "stochastic")),
    "figure-5": Part(MAIN, ("ucf",), ("hopper_medium-zoo",), of_runs=True),
    "figure-6": Part(MAIN, ("ucf",), ("halfcheetah_medium-zoo",), of_runs=True),
}
"""By name. Table 2 is `ucfrec benchmark recommendation`, tables 4 to 8 are settings, and figure 1
is a diagram of the method."""


def budget_of_part(part: Part, name: str) -> Budget:
    """The budget `name` with the files of the part."""
    budget = budget_of(part.table, name)
    return replace(budget, tasks=part.files) if part.files else budget


def cells_of_part(part: Part, data: Path, folder: Path, budget: Budget) -> Iterator[Cell]:
    """The cells of a part; writes the stores that they need.

    Args:
        part: of `PARTS`.
        data: folder of the HDF5 files.
        budget: of `budget_of_part`.

    Raises:
        InputError: a file is missing.
    """
    if part.table == ROBUSTNESS:
        return robustness_cells(data, folder, budget, part.methods, part.distractors)
    return score_cells(data, folder, budget, part.table, part.methods)


def rows_of_part(part: Part, rows: Sequence[ResultRow], name: str) -> list[ResultRow]:
    """The rows of a part.

    Args:
        part: of `PARTS`.
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
