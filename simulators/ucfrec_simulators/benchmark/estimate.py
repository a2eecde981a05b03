"""How long the cells of a benchmark take on the machine that they were measured on."""

from collections.abc import Callable, Sequence
from typing import Final

from ucfrec_simulators.benchmark.cells import Cell

_PER_STEP: Final = {"kuairand": 0.1, "kuairec": 0.1, "sardine-boredinf": 0.1}
"""CPU seconds of a training step of width 64, by task; `_STEP` for others."""
_BEFORE: Final = {"kuairand": 45.0, "kuairec": 45.0}
"""CPU seconds of copies and their reward model, by task; `_COPIES` for others."""
_CHOICE: Final = {"kuairand": 22.0, "kuairec": 22.0, "sardine-boredinf": 65.0}
"""CPU seconds of the reward model of items and the choice of the rule; `_RULE` for others."""
_STEP, _COPIES, _RULE = 0.06, 45.0, 15.0
_EVALUATION: Final = 5.0
"""CPU seconds to evaluate a policy in a world."""


def announcement(workers: int) -> Callable[[Sequence[Cell]], str]:
    """What a benchmark of so many processes says of the cells that are left, before it starts."""

    def said(cells: Sequence[Cell]) -> str:
        hours = estimated_hours(cells) / workers
        return (
            f"about {hours:.1f} hours with --workers {workers} on two idle cores, by what cells of "
            "the small budget took; a larger width takes longer"
        )

    return said


def estimated_hours(cells: Sequence[Cell]) -> float:
    """CPU hours of `cells`; a run that several of them share is counted once."""
    runs = {cell.run: cell for cell in cells if cell.run is not None}
    evaluated = _EVALUATION * sum(len(cell.worlds) for cell in cells)
    return (evaluated + sum(map(_training, runs.values()))) / 3600


def _training(cell: Cell) -> float:
    task, config = cell.task.partition(",")[0], cell.config
    seconds = config.train.steps * _PER_STEP.get(task, _STEP)
    seconds += _BEFORE.get(task, _COPIES) if config.augment.makes_copies else 0.0
    return seconds + (_CHOICE.get(task, _RULE) if config.rule.choose else 0.0)
