"""How long the cells of a benchmark take on the machine that they were measured on."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from ucfrec.files.atomic import read_json
from ucfrec.runs.screened import SCREENING
from ucfrec.runs.trained_policy import RUN
from ucfrec_simulators.benchmark.cells import Cell

_STEP: Final = {"kuairand": 0.045, "kuairec": 0.045, "sardine-boredinf": 0.06}
"""CPU seconds of a training step of width 64, by task."""
_COPIES: Final = {"kuairand": 38.0, "kuairec": 38.0}
"""CPU seconds of a reward model, a generator and their copies, by task."""
_REWARDS: Final = {"sardine-boredinf": 15.0, "sardine-static": 15.0}
"""CPU seconds of a reward model of items, by task."""
_CHOICE: Final = {"kuairand": 8.0, "kuairec": 8.0, "sardine-boredinf": 60.0}
"""CPU seconds of the choice of a decision rule, by task."""
_SCREENING: Final = {"synthetic-taobao": 600.0}
"""CPU seconds of a screening, by task."""
_ELSE: Final = {"step": 0.05, "copies": 40.0, "rewards": 11.0, "choice": 8.0, "screening": 10.0}
"""The same of other tasks."""
_EVALUATION: Final = 5.0
"""CPU seconds to evaluate a policy in an environment."""


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
    """CPU hours of `cells`; what several share is counted once, finished trainings are not."""
    evaluated = _EVALUATION * sum(len(cell.environments) for cell in cells)
    seconds: dict[object, float] = {}
    for cell in cells:
        if cell.run is None or _finished(cell.run):
            continue
        task, config = cell.task.partition(",")[0], cell.config
        log = cell.store, cell.training_seed
        seconds[cell.run] = config.train.steps * _STEP.get(task, _ELSE["step"])
        if config.rule.choose:
            seconds[cell.run] += _CHOICE.get(task, _ELSE["choice"])
            seconds[log] = _REWARDS.get(task, _ELSE["rewards"])
        if cell.screening is not None:
            seconds[cell.store, SCREENING] = _SCREENING.get(task, _ELSE["screening"])
        if config.augment.augments:
            settings = repr((config.crm, config.csg, config.augment))
            seconds[log, settings] = _COPIES.get(task, _ELSE["copies"])
    return (evaluated + sum(seconds.values())) / 3600


def _finished(run: Path) -> bool:
    return (run / RUN).exists() and "policy" in read_json(run / RUN)
