"""Whether screening flags distractors, and nothing else, on every file (resumable)."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ucfrec.episodes.store import EpisodeStore
from ucfrec.provenance import config_hash, provenance
from ucfrec.reporting.grid import Row, run_grid
from ucfrec_control.benchmark.plan import BUDGETS
from ucfrec_control.data.distractor import DISTRACTORS, zoo_store
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.learners.screening import ScreeningConfig, screen

SHOWN = (
    *("dataset", "distractor", "seed", "flagged", "effect", "reward_effect"),
    *("true_flagged", "weakest_true"),
)
SEED = 0


@dataclass(frozen=True)
class Cell:
    """One screening."""

    file: str
    distractor: str
    store: Path
    config: ScreeningConfig


def screening_table(data: Path, folder: Path, results: Path, workers: int) -> list[Row]:
    """Screen every file, plain and with each distractor, that has no row in `results` yet.

    Args:
        data: folder of the nine HDF5 files.
        folder: where stores are kept.
        results: JSON lines.
        workers: processes, of one thread each.

    Raises:
        InputError: a file is missing, `results` holds something else, or cells failed.
    """
    cells = list(_cells(data, folder / "stores"))
    return run_grid(cells, _measure, _keys, results, workers, "screening")


def _cells(data: Path, stores: Path) -> Iterator[Cell]:
    for file in BUDGETS["full"].files:
        for distractor in DISTRACTORS:
            store = zoo_store(data, stores, file, distractor)
            yield Cell(file, distractor, store, ScreeningConfig())


def _keys(cell: Cell) -> Row:
    return {
        "dataset": cell.file,
        "distractor": cell.distractor,
        "seed": SEED,
        "config_hash": config_hash(asdict(cell.config)),
        "fingerprint": EpisodeStore.open(cell.store).meta["fingerprint"],
    }


def _measure(cell: Cell) -> list[Row]:
    store = EpisodeStore.open(cell.store)
    began = time.perf_counter()
    report = asdict(screen(store, cell.config, SEED))
    return [
        {
            "screening": verdicts(report, store),
            "reward_r2": report["reward_r2"],
            "transitions": report["transitions"],
            "config": asdict(cell.config),
            "wall_time_s": time.perf_counter() - began,
            **provenance(PACKAGES),
        }
    ]


def verdicts(report: Mapping[str, Any], store: EpisodeStore) -> list[Row]:
    """What a screening report, as a mapping, says of each dimension of `store`'s states."""
    added = {each["dimension"] for each in store.meta["source"].get("distractors", [])}
    return [
        {
            "dimension": d["dimension"],
            "distractor": d["dimension"] in added,
            "flagged": not d["causes"],
            **{k: d[k] for k in ("effect", "p_value", "reward_effect", "reward_p_value")},
        }
        for d in report["dimensions"]
    ]


def screening_rows(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """For each row with a screening: what was flagged, and how far the verdicts are apart.

    `effect` is the distractor's effect on the next state, `reward_effect` that on the reward; of
    the true dimensions, the weakest cause has the larger of its two effects as `weakest_true`.
    """
    found = []
    for row in rows:
        if "screening" not in row:
            continue
        added = [d for d in row["screening"] if d["distractor"]]
        true = [d for d in row["screening"] if not d["distractor"]]
        found.append(
            {
                **{name: row[name] for name in ("dataset", "distractor", "seed")},
                "flagged": all(d["flagged"] for d in added) if added else "-",
                "effect": added[0]["effect"] if added else "-",
                "reward_effect": added[0]["reward_effect"] if added else "-",
                "true_flagged": [d["dimension"] for d in true if d["flagged"]],
                "weakest_true": min(max(d["effect"], d["reward_effect"]) for d in true),
            }
        )
    return found
