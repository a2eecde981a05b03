"""Sizes of the recommendation benchmark, and the tasks of its tables."""

from collections.abc import Mapping
from typing import Final

from ucfrec.benchmark.cells import Budget, Evaluation

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
