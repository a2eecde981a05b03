"""How long the cells of a benchmark take, from what a suite says of the cost of their parts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ucfrec.benchmark.cells import Cell
from ucfrec.files.atomic import read_json
from ucfrec.runs.trained_policy import RUN


@dataclass(frozen=True)
class Costs:
    """CPU seconds of the parts of a cell."""

    training: Callable[[Cell], float]
    """Of the updates of the cell's policy."""
    evaluation: Callable[[Cell], float]
    note: str
    """Where these numbers come from, and what they exclude."""
    stages: Callable[[Cell], Mapping[object, float]] = lambda cell: {}
    """Of the stages before and after the updates, by a key that cells with a common one share."""


def announcement(costs: Costs, workers: int) -> Callable[[Sequence[Cell]], str]:
    """What a benchmark of so many processes says of the cells that are left, before it starts."""

    def text(cells: Sequence[Cell]) -> str:
        hours = estimated_hours(cells, costs) / workers
        return f"about {hours:.1f} hours with --workers {workers}, {costs.note}"

    return text


def estimated_hours(cells: Sequence[Cell], costs: Costs) -> float:
    """CPU hours of `cells`; what several share is counted once, finished trainings are not."""
    seconds: dict[object, float] = {}
    for cell in cells:
        if cell.run is not None and not _finished(cell.run):
            seconds[cell.run] = costs.training(cell)
            seconds |= costs.stages(cell)
    return (sum(map(costs.evaluation, cells)) + sum(seconds.values())) / 3600


def _finished(run: Path) -> bool:
    return (run / RUN).exists() and "policy" in read_json(run / RUN)
