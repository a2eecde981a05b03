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

UCF's preset tells its policy no time, DT's does; `ucf-w-time` and `dt-wo-time` are the other way
round.
"""

_FAITHFUL, _NOISE = "csg.kind=faithful", "csg.kind=noise"
_NO_GATE = "augment.epsilon_r=1e9"
"""Every change of the reward passes; the limit on a move's length stays."""
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
    # Table 10: λ_band is of the paper's network; of tangent moves, the band is widened instead.
    "band": {
        "ucf": ("ucf", ()),
        "ucf-wide": ("ucf", ("csg.band=[0.2, 2.0]",)),
        "ucf-wo-lower": ("ucf", ("csg.band=[0.0, 0.5]",)),
        "faithful": ("ucf", (_FAITHFUL,)),
        "faithful-wo-band": ("ucf", (_FAITHFUL, "csg.lambda_band=0.0")),
        "faithful-wo-lower": ("ucf", (_FAITHFUL, "csg.band=[0.0, 0.5]")),
    },
    # Does augmentation help at all? Each generator, reading of the copies, with and without gate.
    "augmentation": {
        "ucf-wo-count": ("ucf", ("augment.copies=0",)),
        **{
            f"{name}{reading}{gate}": ("ucf", (*kind, *copies, *open_))
            for name, kind, gates in (
                ("ucf", (), (("", ()), ("-wo-gate", (_NO_GATE,)))),
                ("faithful", (_FAITHFUL,), (("", ()), ("-wo-gate", (_NO_GATE,)))),
                ("noise", (_NOISE,), (("-wo-gate", (_NO_GATE,)),)),
            )
            for reading, copies in (("", ()), ("-algorithm-5", _ALGORITHM_5))
            for gate, open_ in gates
        },
    },
}
"""Rows of each table, as in `METHODS`."""


@dataclass(frozen=True)
class Budget:
    """What is cut from the paper's size, and what is not."""

    files: tuple[str, ...]
    seeds: int
    episodes: int
    settings: tuple[str, ...]
    """Over the presets; none is the authors' size."""
    memoryless: tuple[str, ...] = ()
    """Over those, of `bc`."""
    rl_steps: int = 1_000_000
    """Of IQL and CQL, of `rl_batch_size` transitions each."""
    rl_batch_size: int = 256
    evaluation_seed: int = 1000
    """Of the episodes that are reported; the same for all training seeds and methods."""

    def settings_of(self, learner: str) -> tuple[str, ...]:
        """What the budget sets for a sequence policy or `bc`."""
        return (*self.settings, *(self.memoryless if learner == "bc" else ()))


_TASKS, _KINDS = ("halfcheetah", "hopper", "walker2d"), ("medium", "mixed", "medium-expert")
BUDGETS = {
    # Batches, steps and width are cut most, then files and seeds; no method is left out. One
    # learning rate for all, since the authors' are meant for 25 times as many steps. Batch size,
    # rate and schedule were chosen by the validation loss of DT and UCF (`benchmarks/LOG.md`).
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
        # As many predictions a step as 16 windows of 20; cheap enough to keep its width.
        memoryless=("train.batch_size=320", "policy.dim=128"),
        # A quarter of the authors' batch, as the others have.
        rl_steps=5000,
        rl_batch_size=64,
    ),
    "full": Budget(tuple(f"{t}_{k}-zoo" for t in _TASKS for k in _KINDS), 4, 100, ()),
}

_SMALL, _FULL = BUDGETS["small"], BUDGETS["full"]
SWEEPS = {
    # One file and half the steps, but twice the seeds: a sweep compares UCF with itself, and seeds
    # differ more than settings do.
    "small": replace(
        _SMALL, files=_SMALL.files[:1], seeds=4, settings=(*_SMALL.settings, "train.steps=2000")
    ),
    "full": replace(_FULL, files=("hopper_medium-zoo", "halfcheetah_medium-zoo")),
}
"""Of every table but the main one."""


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
    """Train and evaluate whatever has no row in `results` yet; returns the rows of all cells.

    Args:
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        results: JSON lines.
        name: of the budget, for the rows.
        workers: processes, of one thread each.
        table: a key of `TABLES`.
        methods: rows of the table; empty for all.

    Raises:
        InputError: a file is missing, a method is none of the table's, `results` holds something
            else, or cells failed.
    """
    known = chosen(TABLES[table], methods, "method")
    cells = list(_cells(data, folder, budget, name, table, known))
    return run_grid(cells, SCORE_MEASUREMENT, results, workers, f"benchmark {table}")


def _cells(
    data: Path, folder: Path, budget: Budget, name: str, table: str, methods: Sequence[str]
) -> Iterator[Cell]:
    # One method of two sweeps is one run: trained once, evaluated for the rows of each.
    runs = folder / name / (MAIN if table == MAIN else "sweeps")
    for file in budget.files:
        store = zoo_store(data, stores_of(folder), file)
        for method in methods:
            learner, own = TABLES[table][method]
            code = code_of(learner)
            for seed in range(budget.seeds):
                yield Cell(
                    suite=SCORES,
                    table=table,
                    budget=name,
                    file=file,
                    method=method,
                    learner=learner,
                    settings=(*budget.settings_of(learner), *own),
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
    """Where the stores are that today's code writes."""
    return folder / "stores" / code_version(zoo_store.__module__)


def run_name(method: str, code: str, seed: int) -> str:
    """The folder of a run: other code does not go on with it."""
    return f"{method}-{code}-{seed}"
