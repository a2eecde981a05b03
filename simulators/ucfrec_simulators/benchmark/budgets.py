"""Sizes of the recommendation benchmark, the tasks of its tables, and what its cells cost."""

from collections.abc import Mapping
from typing import Final

from ucfrec.benchmark.cells import Budget, Cell, Evaluation
from ucfrec.benchmark.suite import Costs
from ucfrec.runs.screened import SCREENING

MAIN: Final = ("kuairand", "kuairec", "virtual-taobao", "synthetic-catalog", "sardine-boredinf")
SHARED_TASKS: Final = ("kuairand", "synthetic-catalog", "sardine-boredinf")
"""Tasks of the table of shared components, whose actions are items."""
SWEPT: Final = ("synthetic-catalog", "synthetic-taobao")
"""Tasks that can be swept. Not VirtualTaobao: there all sequence policies reach the maximum
return."""
DISTRACTED: Final = {"synthetic-taobao": 0, "synthetic-catalog": 0, "kuairand": 2}
"""Tasks that can have a distractor, and the index of the environment that is evaluated. Of KuaiRand
that is NX_10: all its sessions have the same length, so early exits do not hide the distractor's
effect."""
BUDGETS: Final[Mapping[str, Budget]] = {
    # Sized for two cores: smaller width, fewer steps, smaller logs, fewer tasks beside those of the
    # main table, and cheaper settings of two baselines; methods and seeds are not reduced.
    "small": Budget(
        name="small",
        seeds=3,
        logs=2,
        tasks=MAIN,
        tasks_of={
            "shared": SHARED_TASKS,
            "sweeps": ("synthetic-catalog",),
            "distractor": ("synthetic-catalog",),
        },
        sessions=6000,
        settings=(
            "policy.dim=64",
            "train.steps=400",
            "train.learning_rate=1e-3",
            "train.warmup_steps=40",
            "train.validate_every=100",
            "train.average=0.0",
            "crm.epochs=8",
            "crm.learning_rate=4e-3",
            "rule.sessions=50",
            "rule.evidence=0",
        ),
        of_policies={"dt4rec": ("policy.negatives=1",), "edt4rec": ("policy.cql_steps=400",)},
        evaluation=Evaluation(episodes=300, seed=1_000_000),
    ),
    "full": Budget(
        name="full",
        seeds=5,
        logs=3,
        tasks=(*MAIN, "sardine-static"),
        tasks_of={"shared": SHARED_TASKS, "sweeps": SWEPT, "distractor": tuple(DISTRACTED)},
        sessions=50_000,
        settings=("train.steps=20000", "train.learning_rate=3e-4", "rule.evidence=0"),
        evaluation=Evaluation(episodes=5000, seed=1_000_000),
    ),
}


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
