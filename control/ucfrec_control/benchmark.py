"""Every learner on the zoo files, seeds side by side: rows of Table 1 and Table 3 (resumable)."""

import json
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from ucfrec.config import Config, resolve_config
from ucfrec.errors import InputError
from ucfrec.results import config_hash, provenance
from ucfrec.store import EpisodeStore
from ucfrec_control.d4rl import read_d4rl
from ucfrec_control.evaluate import CHECKPOINTS, evaluate_run
from ucfrec_control.train import dataset_of, preset_of, train_control
from ucfrec_control.trajectories import PACKAGES

METHODS: dict[str, tuple[str, tuple[str, ...]]] = {
    "bc": ("bc", ()),
    "dt": ("dt", ()),
    "dc": ("dc", ()),
    "lsdt": ("lsdt", ()),
    "ucf": ("ucf", ()),
    "ucf-wo-count": ("ucf", ("augment.copies=0",)),
    "ucf-wo-arch": ("dt", ("augment.copies=1",)),
}
"""Learner and settings by the name of the table's row; the last two are Table 3's ablations."""


@dataclass(frozen=True)
class Budget:
    """What is cut from the paper's size, and what is not."""

    files: tuple[str, ...]
    seeds: int
    episodes: int
    settings: tuple[str, ...]
    """Over the presets; none is the authors' size."""


_TASKS, _KINDS = ("halfcheetah", "hopper", "walker2d"), ("medium", "mixed", "medium-expert")
BUDGETS = {
    # Steps and width are cut most, then files and seeds; no method is left out. Learning rates
    # are one for all, since the authors' are meant for fifty times as many steps.
    "small": Budget(
        ("hopper_medium-zoo", "hopper_mixed-zoo", "walker2d_medium-expert-zoo"),
        2,
        20,
        (
            "train.steps=2000",
            "train.warmup_steps=100",
            "train.validate_every=500",
            "train.learning_rate=1e-3",
            "policy.dim=64",
            "crm.epochs=5",
            "csg.epochs=5",
        ),
    ),
    "full": Budget(tuple(f"{t}_{k}-zoo" for t in _TASKS for k in _KINDS), 4, 100, ()),
}


@dataclass(frozen=True)
class Cell:
    """One training, and the rows it gives."""

    method: str
    store: Path
    run: Path
    seed: int
    settings: tuple[str, ...]
    episodes: int

    @property
    def config(self) -> Config:
        """All that decides it, with its data."""
        policy, own = METHODS[self.method]
        preset = preset_of(dataset_of(EpisodeStore.open(self.store)), policy)
        return resolve_config(policy, None, [*self.settings, *own], self.seed, preset.tables)


def benchmark(
    data: Path, folder: Path, results: Path, budget: Budget, name: str, workers: int
) -> list[dict[str, Any]]:
    """Train and judge whatever has no row in `results` yet; returns all rows of the budget.

    Every finished cell's rows are appended at once; a cell that was interrupted goes on from its
    last checkpoint.

    Args:
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        results: JSON lines.
        name: of the budget, for the rows.
        workers: processes, of one thread each.

    Raises:
        InputError: a file is missing, or `results` holds something else.
    """
    cells = list(_cells(data, folder, budget, name))
    known = _read(results)
    missing = [cell for cell in cells if len(_rows_of(cell, known)) < len(CHECKPOINTS)]
    spawn = multiprocessing.get_context("spawn")
    results.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(workers, mp_context=spawn) as pool:
        waiting = [pool.submit(_run, cell) for cell in missing]
        bar = tqdm(as_completed(waiting), "benchmark", len(waiting), unit="run", disable=None)
        for done in bar:
            rows = [row | {"budget": name} | provenance(PACKAGES) for row in done.result()]
            with results.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(row) + "\n" for row in rows)
            known += rows
    return [row for cell in cells for row in _rows_of(cell, known)]


def _cells(data: Path, folder: Path, budget: Budget, name: str) -> Iterator[Cell]:
    for file in budget.files:
        store = folder / "stores" / file
        if not store.exists():
            read_d4rl(data / f"{file}.hdf5").write_store(store)
        for method in METHODS:
            for seed in range(budget.seeds):
                run = folder / name / file / f"{method}-{seed}"
                yield Cell(method, store, run, seed, budget.settings, budget.episodes)


def _run(cell: Cell) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    store = EpisodeStore.open(cell.store)
    train_control(store, cell.run, cell.config)
    target = preset_of(dataset_of(store), METHODS[cell.method][0]).targets[:1]
    # Starts are those of no other seed's training, and the same for every method.
    rows = evaluate_run(cell.run, episodes=cell.episodes, seed=1000 + cell.seed, targets=target)
    return [row | {"method": cell.method} for row in rows]


def _rows_of(cell: Cell, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The latest row of each checkpoint, of this configuration on this data."""
    wanted = {
        "method": cell.method,
        "seed": cell.seed,
        "episodes": cell.episodes,
        "config_hash": config_hash(_plain(cell.config)),
        "fingerprint": EpisodeStore.open(cell.store).meta["fingerprint"],
    }
    found = [row for row in rows if wanted == {name: row.get(name) for name in wanted}]
    return list({row["checkpoint"]: row for row in found}.values())


def _plain(config: Config) -> dict[str, Any]:
    """The configuration as a run's record has it, after JSON."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(config)))
    return plain


def _read(results: Path) -> list[dict[str, Any]]:
    if not results.exists():
        return []
    rows = []
    for number, line in enumerate(results.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            rows.append(dict(json.loads(line)))
        except (ValueError, TypeError):
            raise InputError(
                f"{results}, line {number}, is no result row; delete the line to measure it again"
            ) from None
    return rows
