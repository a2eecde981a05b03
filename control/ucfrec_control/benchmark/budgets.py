"""Sizes of the control benchmarks."""

from dataclasses import replace
from typing import Final

from ucfrec.benchmark.cells import PAPER_UCF, Budget, Evaluation
from ucfrec_control.benchmark.methods import (
    EQUAL_TIME,
    LAMBDA,
    LONGER,
    MAIN,
    METHODS,
    PURSUING,
    ROBUSTNESS,
    TABLES,
    WITH_TIME,
    WITHOUT_TIME,
)
from ucfrec_control.training.rl_baselines import ALGORITHMS


def _longer(steps: int) -> dict[str, tuple[str, ...]]:
    """Settings of the methods that have more steps than the budget's `steps`."""
    return {method: (f"train.steps={more * steps}",) for method, more in LONGER.items()}


_TASKS, _KINDS = ("halfcheetah", "hopper", "walker2d"), ("medium", "mixed", "medium-expert")
ZOO: Final = tuple(f"{task}_{kind}-zoo" for task in _TASKS for kind in _KINDS)
"""The HDF5 files, without their ending."""
ANTMAZE: Final = ("antmaze-umaze-v2", "antmaze-umaze-diverse-v2")
"""D4RL's files of the paper's AntMaze columns, under the names of their datasets."""
MEDIUM: Final = tuple(f"{task}_medium-zoo" for task in _TASKS)
"""Files of Appendix G.4."""
_SWEPT: Final = ("hopper_medium-zoo", "halfcheetah_medium-zoo")
"""Files of Tables 9 and 10."""
_FEWER: Final = {
    **{table: _SWEPT for table in TABLES if table not in (MAIN, PURSUING, EQUAL_TIME, LAMBDA)},
    ROBUSTNESS: MEDIUM,
}
_ONE_SEED: Final = tuple(n for n in METHODS if n.startswith(PAPER_UCF))
"""The width and the batches of the paper's settings are not reduced."""
BUDGETS: Final = {
    # Batches, steps and width are reduced, of the paper's settings only the steps; no file and no
    # method is excluded.
    # At a quarter of the steps sequence policies are below cloning (benchmarks/LOG.md).
    # The authors' learning rates are for 50 times as many steps: see `rates.toml` instead.
    "small": Budget(
        name="small",
        tasks=ZOO,
        tasks_of={**_FEWER, LAMBDA: _SWEPT},
        seeds=4,
        seeds_in={ROBUSTNESS: 2},
        evaluation=Evaluation(episodes=20, seed=1000),
        settings=(
            *("train.steps=4000", "train.batch_size=16", "train.warmup_steps=100"),
            *("train.validate_every=2000", "train.learning_rate=3e-3", "train.cosine=true"),
            *("train.average=0.0", "policy.dim=64"),
            *("crm.epochs=3", "crm.learning_rate=4e-3", "csg.epochs=5"),
        ),
        of_policies={
            # As many predictions per update as 16 windows of 20 steps; cheap enough for the full
            # width.
            "bc": ("train.batch_size=320", "policy.dim=128"),
            # They learn from single steps, not from windows of 20, and need more updates. After
            # 20,000 IQL had not learned: its held-out action loss was still falling
            # (benchmarks/LOG.md). CQL's updates take eight times as long, so it has fewer, and one
            # seed. A quarter of the authors' batch size, as for the others.
            "iql": ("steps=50000", "batch_size=64"),
            "cql": ("steps=10000", "batch_size=64"),
        },
        of_methods=_longer(4_000),
        # Embeddings of time make every policy predict held-out actions worse (benchmarks/LOG.md):
        # one seed says what they cost.
        fewer_seeds=dict.fromkeys(("cql", *WITH_TIME, *_ONE_SEED), 1),
    ),
    # Trainings long enough to tell methods apart: averaged weights, ten times as many windows as
    # the small budget and twice its width. Few enough for one computer in a day.
    "medium": Budget(
        name="medium",
        tasks=ZOO,
        tasks_of=_FEWER,
        methods=(*WITHOUT_TIME, PAPER_UCF),
        fewer_seeds={PAPER_UCF: 1},
        seeds=2,
        seeds_in={ROBUSTNESS: 2},
        evaluation=Evaluation(episodes=50, seed=1000),
        settings=(
            *("train.steps=10000", "train.batch_size=64", "train.warmup_steps=500"),
            *("train.validate_every=1000", "train.learning_rate=1e-3", "train.cosine=false"),
            *("policy.dim=128", "policy.context=8"),
            *("crm.epochs=3", "crm.learning_rate=4e-3", "csg.epochs=5"),
        ),
        of_policies={
            # As many predictions per update as 64 windows of 8 steps.
            "bc": ("train.batch_size=512", "policy.context=1"),
            "iql": ("steps=200000",),
            "cql": ("steps=50000",),
        },
        of_methods=_longer(10_000),
    ),
    # Seeds, episodes, steps, widths and targets of the paper and of each method's authors.
    "full": Budget(
        name="full",
        tasks=(*ZOO, *ANTMAZE),
        optional=ANTMAZE,
        tasks_of=_FEWER,
        seeds=5,
        evaluation=Evaluation(episodes=100, seed=1000, all_targets=True),
        of_policies=dict.fromkeys(ALGORITHMS, ("steps=1000000",)),
        of_methods=_longer(100_000),
        fewer_seeds=dict.fromkeys(ANTMAZE, 4),
    ),
}


def budget_of(table: str, name: str) -> Budget:
    """The budget `name` of a table of scores or of the robustness table, with its tasks as
    `Budget.tasks`."""
    budget = BUDGETS[name]
    every = budget.evaluation.all_targets and table in (MAIN, PURSUING, EQUAL_TIME)
    return replace(
        budget,
        tasks=budget.tasks_in(table),
        tasks_of={},
        seeds=budget.seeds_in.get(table, budget.seeds),
        methods=budget.methods if table == MAIN else (),
        evaluation=replace(budget.evaluation, all_targets=every),
    )
