"""What the cells of the recommendation benchmark cost on the machine they were measured on."""

from typing import Final

from ucfrec.benchmark.cells import Cell
from ucfrec.benchmark.estimate import Costs
from ucfrec.runs.screened import SCREENING

_STEP: Final = {"kuairand": 0.045, "kuairec": 0.045, "sardine-boredinf": 0.06}
"""CPU seconds of a training step of width 64, by task."""
_AUGMENTATION: Final = {"kuairand": 38.0, "kuairec": 38.0}
"""CPU seconds of a reward model, a generator and their augmentation, by task."""
_REWARDS: Final = {"sardine-boredinf": 15.0, "sardine-static": 15.0}
"""CPU seconds of a reward model of items, by task."""
_CHOICE: Final = {"kuairand": 8.0, "kuairec": 8.0, "sardine-boredinf": 60.0}
"""CPU seconds of the choice of a decision rule, by task."""
_SCREENING: Final = {"synthetic-taobao": 600.0}
"""CPU seconds of a screening, by task."""
_ELSE: Final = {"step": 0.05, "augmentation": 40.0, "rewards": 11.0, "choice": 8.0}
"""The same of other tasks."""
_EVALUATION: Final = 5.0
"""CPU seconds to evaluate a policy in an environment."""


def _task(cell: Cell) -> str:
    return cell.task.partition(",")[0]


def _training(cell: Cell) -> float:
    return cell.config.train.steps * _STEP.get(_task(cell), _ELSE["step"])


def _stages(cell: Cell) -> dict[object, float]:
    task, config, found = _task(cell), cell.config, dict[object, float]()
    log = cell.store, cell.training_seed
    if config.rule.choose:
        found[cell.run, "choice"] = _CHOICE.get(task, _ELSE["choice"])
        found[log] = _REWARDS.get(task, _ELSE["rewards"])
    if cell.screening is not None:
        found[cell.store, SCREENING] = _SCREENING.get(task, 10.0)
    if config.augment.augments:
        settings = repr((config.crm, config.csg, config.augment))
        found[log, settings] = _AUGMENTATION.get(task, _ELSE["augmentation"])
    return found


COSTS: Final = Costs(
    training=_training,
    evaluation=lambda cell: _EVALUATION * len(cell.environments),
    note="on two idle cores, by what cells of the small budget took; a larger width takes longer",
    stages=_stages,
)
