"""Sizes of the control benchmarks."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ucfrec_control.benchmark.methods import LONGER, WITH_TIME
from ucfrec_control.environments.scores import find_task
from ucfrec_control.training.rl_baselines import ALGORITHMS


@dataclass(frozen=True)
class Budget:
    """The size of a benchmark; every budget measures all methods."""

    files: tuple[str, ...]
    seeds: int
    """Training seeds, but of AntMaze and of `fewer_seeds`."""
    episodes: int
    settings: tuple[str, ...]
    """Settings over the presets; without any, trainings have the authors' size."""
    memoryless: tuple[str, ...] = ()
    """Further settings of `bc`."""
    of_methods: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Further settings of single methods, by name."""
    rl: Mapping[str, Mapping[str, Any]] = field(
        default_factory=lambda: {name: {"steps": 1_000_000} for name in ALGORITHMS}
    )
    """Settings of IQL and of CQL, as of `rl_config`, by algorithm."""
    evaluation_seed: int = 1000
    """Seed of the reported episodes; the same for all training seeds and methods."""
    where_present: tuple[str, ...] = ()
    """Further files, which are measured where they are."""
    antmaze_seeds: int = 0
    """Training seeds of AntMaze; 0 for `seeds`."""
    fewer_seeds: Mapping[str, int] = field(default_factory=dict)
    """Training seeds of methods that have fewer than the file, by name."""
    all_targets: bool = False
    """Whether a policy is asked for every target return of its preset, or for the first."""
    rates: Mapping[str, float] | None = None
    """Learning rates by method; None for those that come with the package."""

    def files_in(self, data: Path) -> tuple[str, ...]:
        """`files`, and those of `where_present` that lie in the folder `data`."""
        present = [file for file in self.where_present if (data / f"{file}.hdf5").exists()]
        return (*self.files, *present)

    def seeds_of(self, file: str, method: str) -> int:
        """The number of training seeds of a method on a file."""
        task = find_task(file)
        of_antmaze = task is not None and task.name == "antmaze"
        seeds = self.antmaze_seeds or self.seeds if of_antmaze else self.seeds
        return min(seeds, self.fewer_seeds.get(method, seeds))

    def settings_of(self, learner: str) -> tuple[str, ...]:
        """The budget's settings for a sequence policy or `bc`."""
        return (*self.settings, *(self.memoryless if learner == "bc" else ()))


def _longer(steps: int) -> dict[str, tuple[str, ...]]:
    """Settings of the methods that have more steps than the budget's `steps`."""
    return {method: (f"train.steps={more * steps}",) for method, more in LONGER.items()}


_TASKS, _KINDS = ("halfcheetah", "hopper", "walker2d"), ("medium", "mixed", "medium-expert")
ANTMAZE = ("antmaze-umaze-v2", "antmaze-umaze-diverse-v2")
"""D4RL's files of the paper's AntMaze columns, under the names of their datasets."""
_ALL = tuple(f"{task}_{kind}-zoo" for task in _TASKS for kind in _KINDS)
BUDGETS = {
    # Batches, steps and width are reduced; no file and no method is left out.
    # At a quarter of the steps sequence policies are below cloning (benchmarks/LOG.md).
    # The authors' learning rates are for 50 times as many steps: see `rates.toml` instead.
    "small": Budget(
        _ALL,
        4,
        20,
        (
            "train.steps=4000",
            "train.batch_size=16",
            "train.warmup_steps=100",
            "train.validate_every=2000",
            "train.learning_rate=3e-3",
            "train.cosine=true",
            "policy.dim=64",
            "crm.epochs=3",
            "crm.learning_rate=4e-3",
            "csg.epochs=5",
        ),
        # As many predictions per update as 16 windows of 20 steps; cheap enough for the full width.
        memoryless=("train.batch_size=320", "policy.dim=128"),
        of_methods=_longer(4_000),
        # They learn from single steps, not from windows of 20, and need more updates. After 20,000
        # IQL had not learned: its held-out action loss was still falling (benchmarks/LOG.md). CQL's
        # updates take eight times as long, so it has fewer, and one seed. A quarter of the authors'
        # batch size, as for the others.
        rl={
            "iql": {"steps": 50_000, "batch_size": 64},
            "cql": {"steps": 10_000, "batch_size": 64},
        },
        # Embeddings of time make every learner predict held-out actions worse
        # (benchmarks/LOG.md): one seed says what they cost.
        fewer_seeds=dict.fromkeys(("cql", *WITH_TIME), 1),
    ),
    # Seeds, episodes, steps, widths and targets of the paper and of each method's authors.
    "full": Budget(
        _ALL,
        5,
        100,
        (),
        of_methods=_longer(100_000),
        where_present=ANTMAZE,
        antmaze_seeds=4,
        all_targets=True,
    ),
}

MEDIUM = tuple(f"{task}_medium-zoo" for task in _TASKS)
"""Files of Appendix G.4."""
_SWEPT = ("hopper_medium-zoo", "halfcheetah_medium-zoo")
"""Files of Tables 9 and 10."""
_SMALL, _FULL = BUDGETS["small"], BUDGETS["full"]
SWEEPS = {
    "small": replace(_SMALL, files=_SWEPT),
    "full": replace(_FULL, files=_SWEPT, where_present=(), all_targets=False),
}
"""Budgets of the sweeps over UCF's settings."""
WEIGHTS = {"small": SWEEPS["small"], "full": replace(_FULL, all_targets=False)}
"""Budgets of the sweep over λ: Figure 2 has all of locomotion, and AntMaze."""
_TRIED = ("halfcheetah_medium-expert-zoo", "hopper_medium-zoo", "walker2d_mixed-zoo")
SEARCHES = {
    name: replace(budget, files=_TRIED, where_present=(), seeds=1)
    for name, budget in BUDGETS.items()
}
"""Budgets of the search for learning rates: each task and each kind of data once."""
RATES = {"small": (2e-3, 6e-3, 2e-2), "full": (1e-4, 3e-4, 1e-3)}
"""Learning rates that are tried, by the name of the budget."""
