"""Every learner on the zoo files (Tables 1 and 3), and sweeps over UCF's settings (resumable)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ucfrec.code_version import code_version
from ucfrec.reporting.grid import chosen, run_grid
from ucfrec.reporting.result_row import ResultRow
from ucfrec_control.benchmark.cells import SCORE_MEASUREMENT, SCORES, Cell, code_of
from ucfrec_control.data.distractor import zoo_store

Methods = dict[str, tuple[str, tuple[str, ...]]]
METHODS: Methods = {
    "bc": ("bc", ()),
    "bc-10": ("bc", ("policy.best_share=0.1",)),
    "bc-25": ("bc", ("policy.best_share=0.25",)),
    "iql": ("iql", ()),
    "cql": ("cql", ()),
    "dt": ("dt", ()),
    "dt-wo-time": ("dt", ("policy.max_timestep=1",)),
    "dc": ("dc", ()),
    "lsdt": ("lsdt", ()),
    "ucf": ("ucf", ()),
    "ucf-w-time": ("ucf", ("policy.max_timestep=1000",)),
    "ucf-wo-count": ("ucf", ("augment.copies=0",)),
    "ucf-wo-arch": ("dt", ("augment.copies=1",)),
}
"""Learner and settings by the name of the table's row; the last two are Table 3's ablations.

UCF's preset has no embedding of time steps and DT's has one; `ucf-w-time` and `dt-wo-time` are the
reverse.
"""

_FAITHFUL, _NOISE = "csg.kind=faithful", "csg.kind=noise"
_NO_GATE = "augment.epsilon_r=1e9"
"""Disables the gate on the change of the reward; the limit on a move's length stays."""
_ALGORITHM_5 = ("augment.copies=3", "augment.edits_per_copy=1", "augment.reward_quantile=0.0")
MAIN = "main"
TABLES: dict[str, Methods] = {
    MAIN: METHODS,
    # Figure 2.
    "lambda": {
        f"ucf-lambda-{weight:g}": ("ucf", (f"policy.lambda_mask={weight}",))
        for weight in (0.0, 0.05, 0.1, 0.25, 0.5, 1.0)
    },
    # Table 9, with each generator.
    "gate": {
        "ucf": ("ucf", ()),
        "ucf-wo-gate": ("ucf", (_NO_GATE,)),
        "faithful": ("ucf", (_FAITHFUL,)),
        "faithful-wo-gate": ("ucf", (_FAITHFUL, _NO_GATE)),
    },
    # Table 10: λ_band exists for the paper's network only; for tangent moves the band is widened.
    "band": {
        "ucf": ("ucf", ()),
        "ucf-wide": ("ucf", ("csg.band=[0.2, 2.0]",)),
        "ucf-wo-lower": ("ucf", ("csg.band=[0.0, 0.5]",)),
        "faithful": ("ucf", (_FAITHFUL,)),
        "faithful-wo-band": ("ucf", (_FAITHFUL, "csg.lambda_band=0.0")),
        "faithful-wo-lower": ("ucf", (_FAITHFUL, "csg.band=[0.0, 0.5]")),
    },
    # Does augmentation help? Each generator and variant of the copies, with and without gate.
    "augmentation": {
        "ucf-wo-count": ("ucf", ("augment.copies=0",)),
        **{
            f"{name}{variant}{gate}": ("ucf", (*kind, *copies, *gate_settings))
            for name, kind, gates in (
                ("ucf", (), (("", ()), ("-wo-gate", (_NO_GATE,)))),
                ("faithful", (_FAITHFUL,), (("", ()), ("-wo-gate", (_NO_GATE,)))),
                ("noise", (_NOISE,), (("-wo-gate", (_NO_GATE,)),)),
            )
            for variant, copies in (("", ()), ("-algorithm-5", _ALGORITHM_5))
            for gate, gate_settings in gates
        },
    },
}
"""Rows of each table, as in `METHODS`."""


@dataclass(frozen=True)
class Budget:
    """The size of a benchmark; every budget measures all methods."""

    files: tuple[str, ...]
    seeds: int
    episodes: int
    settings: tuple[str, ...]
    """Settings over the presets; without any, trainings have the authors' size."""
    memoryless: tuple[str, ...] = ()
    """Further settings of `bc`."""
    rl_steps: int = 1_000_000
    """Updates of IQL and CQL."""
    rl_batch_size: int = 256
    """Transitions per update of IQL and CQL."""
    evaluation_seed: int = 1000
    """Seed of the reported episodes; the same for all training seeds and methods."""

    def settings_of(self, learner: str) -> tuple[str, ...]:
        """The budget's settings for a sequence policy or `bc`."""
        return (*self.settings, *(self.memoryless if learner == "bc" else ()))


_TASKS, _KINDS = ("halfcheetah", "hopper", "walker2d"), ("medium", "mixed", "medium-expert")
BUDGETS = {
    # Batches, steps and width are reduced most, then files and seeds; no method is left out. All
    # methods share one learning rate, as the authors' are for 25 times as many steps. Batch size,
    # learning rate and schedule were chosen by validation loss (`benchmarks/LOG.md`).
    "small": Budget(
        ("hopper_medium-zoo", "hopper_mixed-zoo", "walker2d_medium-expert-zoo"),
        2,
        20,
        (
            "train.steps=4000",
            "train.batch_size=16",
            "train.warmup_steps=100",
            "train.validate_every=1000",
            "train.learning_rate=3e-3",
            "train.cosine=true",
            "policy.dim=64",
            "crm.epochs=3",
            "csg.epochs=5",
        ),
        # As many predictions per update as 16 windows of 20 steps; cheap enough for the full width.
        memoryless=("train.batch_size=320", "policy.dim=128"),
        # A quarter of the authors' batch size, as for the other methods.
        rl_steps=5000,
        rl_batch_size=64,
    ),
    "full": Budget(tuple(f"{t}_{k}-zoo" for t in _TASKS for k in _KINDS), 4, 100, ()),
}

_SMALL, _FULL = BUDGETS["small"], BUDGETS["full"]
SWEEPS = {
    # One file and half the steps, but twice the seeds: the settings of a sweep differ less in score
    # than seeds do.
    "small": replace(
        _SMALL, files=_SMALL.files[:1], seeds=4, settings=(*_SMALL.settings, "train.steps=2000")
    ),
    "full": replace(_FULL, files=("hopper_medium-zoo", "halfcheetah_medium-zoo")),
}
"""Budgets of every table but the main one."""


def benchmark(
    data: Path,
    folder: Path,
    results: Path,
    budget: Budget,
    name: str,
    workers: int,
    table: str = MAIN,
    methods: Sequence[str] = (),
) -> list[ResultRow]:
    """Train and evaluate the cells without a row in `results`; returns the rows of all cells.

    Args:
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        results: file of JSON lines.
        budget: size of the benchmark.
        name: name of the budget, for the rows.
        workers: number of processes, of one thread each.
        table: a key of `TABLES`.
        methods: rows of the table; empty for all.

    Raises:
        InputError: a file is missing, a method is not in the table, `results` has other content,
            or cells failed.
    """
    selected = chosen(TABLES[table], methods, "method")
    cells = list(_cells(data, folder, budget, name, table, selected))
    return run_grid(cells, SCORE_MEASUREMENT, results, workers, f"benchmark {table}")


def _cells(
    data: Path, folder: Path, budget: Budget, name: str, table: str, methods: Sequence[str]
) -> Iterator[Cell]:
    # A method of two sweeps shares one run: trained once, evaluated for the rows of both.
    runs = folder / name / (MAIN if table == MAIN else "sweeps")
    for file in budget.files:
        store = zoo_store(data, stores_of(folder), file)
        for method in methods:
            learner, method_settings = TABLES[table][method]
            code = code_of(learner)
            for seed in range(budget.seeds):
                yield Cell(
                    suite=SCORES,
                    table=table,
                    budget=name,
                    file=file,
                    method=method,
                    learner=learner,
                    settings=(*budget.settings_of(learner), *method_settings),
                    store=store,
                    run=runs / file / run_name(method, code, seed),
                    seed=seed,
                    episodes=budget.episodes,
                    evaluation_seed=budget.evaluation_seed,
                    code_version=code,
                    rl_steps=budget.rl_steps,
                    rl_batch_size=budget.rl_batch_size,
                )


def stores_of(folder: Path) -> Path:
    """The folder of the stores that this version of the code writes."""
    return folder / "stores" / code_version(zoo_store.__module__)


def run_name(method: str, code: str, seed: int) -> str:
    """The folder name of a run, with the code's version: other code must not resume it."""
    return f"{method}-{code}-{seed}"
