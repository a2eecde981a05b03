"""Screening of every file: are distractors flagged, and only these? (resumable)"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any, Final

from ucfrec.benchmark.cells import Cell, Evaluation, measured_by, opened
from ucfrec.counterfactual.screening import DimensionReport, ScreeningConfig, screen
from ucfrec.episodes.store import EpisodeStore
from ucfrec.provenance import provenance
from ucfrec.reporting.tables import NONE
from ucfrec.results.row import ResultRow, RowKey
from ucfrec.runs.start import training_views
from ucfrec_control.data.distractor import DISTRACTORS, zoo_store
from ucfrec_control.data.trajectories import PACKAGES

SHOWN: Final = (
    *("task", "distractor", "training_seed", "flagged", "effect", "reward_effect"),
    *("true_flagged", "weakest_true"),
)
SEED: Final = 0
SCREENING: Final = "screening"
"""Suite of the rows."""


def screening_cells(data: Path, stores: Path, files: Sequence[str]) -> Iterator[Cell]:
    """A cell for each file, clean and with each distractor.

    Args:
        data: folder of the HDF5 files.
        stores: where stores are kept.
        files: names of files in `data`, without their ending.

    Raises:
        InputError: a file is missing.
    """
    for file, distractor in product(files, DISTRACTORS):
        yield Cell(
            *(SCREENING, SCREENING, file, SCREENING, SCREENING, Evaluation(0, SEED)),
            training_seed=SEED,
            store=zoo_store(data, stores, file, distractor),
            conditions={"distractor": distractor},
        )


def _config(cell: Cell) -> dict[str, Any]:
    return asdict(ScreeningConfig())


def _measure(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    store = opened(cell)
    began = time.perf_counter()
    report = screen(training_views(store)[0], ScreeningConfig(), SEED)
    dimensions = verdicts(report.dimensions, store)
    wrong = sum(each["flagged"] and not each["distractor"] for each in dimensions)
    row = ResultRow(
        **vars(row_key),
        metric="true_flagged",
        metrics={
            "true_flagged": float(wrong),
            "reward_r2": math.nan if report.reward_r2 is None else report.reward_r2,
            "transitions": float(report.transitions),
        },
        details={"screening": dimensions},
        wall_time_s=time.perf_counter() - began,
        **provenance(PACKAGES),
    )
    return [row]


SCREENING_MEASUREMENT: Final = measured_by(_measure, _config)


def verdicts(dimensions: Sequence[DimensionReport], store: EpisodeStore) -> list[dict[str, Any]]:
    """The verdict of a screening report on each state dimension of `store`."""
    added = {each["dimension"] for each in store.record.source.others.get("distractors", [])}
    return [
        {
            "dimension": d.dimension,
            "distractor": d.dimension in added,
            "flagged": not d.causes,
            "effect": d.effect,
            "p_value": d.p_value,
            "reward_effect": d.reward_effect,
            "reward_p_value": d.reward_p_value,
        }
        for d in dimensions
    ]


def screening_rows(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """One line per row with a screening: flagged dimensions and estimated effects.

    `effect` and `reward_effect` are those of the distractor on the next state and on the reward.
    `weakest_true` is the smallest effect among the true dimensions, of each the larger one of the
    two; dimensions that were not tested are excluded.
    """
    lines: list[dict[str, Any]] = []
    for row in rows:
        verdicts = row.details.get("screening")
        if verdicts is None:
            continue
        added = [d for d in verdicts if d["distractor"]]
        true = [d for d in verdicts if not d["distractor"]]
        effects = [max(d["effect"], d["reward_effect"]) for d in true if d["effect"] is not None]
        lines.append(
            {
                "task": row.task,
                "distractor": row.conditions["distractor"],
                "training_seed": row.training_seed,
                "flagged": all(d["flagged"] for d in added) if added else NONE,
                "effect": added[0]["effect"] if added else NONE,
                "reward_effect": added[0]["reward_effect"] if added else NONE,
                "true_flagged": [d["dimension"] for d in true if d["flagged"]],
                "weakest_true": min(effects, default=NONE),
            }
        )
    return lines
