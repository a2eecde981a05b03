"""What a distractor costs the learners that were trained with it (Figures 3 and 4, Appendix G.4).

Every learner is trained on the plain data and on the same data with a distractor in its states, and
judged where the distractor is fixed to 0. Two such trainings differ by their luck too; what one
policy earns where it is fixed to 1 instead tells of the distractor alone.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ucfrec.episodes.store import EpisodeStore
from ucfrec.provenance import config_hash, provenance
from ucfrec.reporting.grid import Row, run_grid
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.run import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.benchmark.plan import BUDGETS as SCORE_BUDGETS
from ucfrec_control.benchmark.plan import METHODS as LEARNERS
from ucfrec_control.benchmark.plan import Budget, chosen
from ucfrec_control.benchmark.screening_table import verdicts
from ucfrec_control.data.distractor import CLEAN, DISTRACTORS, zoo_store
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.learners.evaluate import evaluate_run
from ucfrec_control.learners.train import UNSEEN, as_seen, dataset_of, preset_of, train_control

SCREENED = {"ucf-screened": "copies", "ucf-dropped": "drop"}
"""UCF with copies that intervene on what screening flags, and UCF that is not shown it."""
METHODS = ("dt", "dc", "lsdt", "ucf", "ucf-wo-count", "ucf-wo-arch", *SCREENED)
"""Rows of `ucfrec_control.benchmark.plan`, and those."""

BUDGETS = {
    # As the benchmark's, with fewer seeds and steps and half the history; no method and no
    # distractor is left out.
    "small": replace(
        SCORE_BUDGETS["small"],
        seeds=1,
        settings=(*SCORE_BUDGETS["small"].settings, "train.steps=3000", "policy.context=10"),
    ),
    "full": SCORE_BUDGETS["full"],
}
SHOWN = ("clean", "score", "drop", "score_at_one")
SHOWN_LOSSES = ("loss", "loss_at_zero", "rise")
_LOSS_BATCHES, _LOSS_BATCH = 8, 512


@dataclass(frozen=True)
class Cell:
    """One training, and the row it gives."""

    file: str
    distractor: str
    method: str
    seed: int
    store: Path
    run: Path
    budget: Budget
    budget_name: str

    @property
    def learner(self) -> str:
        """The row of `ucfrec_control.benchmark.plan` that is trained."""
        return "ucf" if self.method in SCREENED else self.method


def robustness(
    data: Path,
    folder: Path,
    results: Path,
    budget: Budget,
    name: str,
    workers: int,
    methods: Sequence[str] = (),
) -> list[Row]:
    """Train and judge whatever has no row in `results` yet; returns all rows asked for.

    Args:
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        results: JSON lines.
        name: of the budget, for the rows.
        workers: processes, of one thread each.
        methods: of `METHODS`; empty for all.

    Raises:
        InputError: a file is missing, a method is unknown, `results` holds something else, or cells
            failed.
    """
    cells = list(_cells(data, folder, budget, name, chosen(METHODS, methods)))
    return run_grid(cells, _measure, _keys, results, workers, "robustness")


def _cells(
    data: Path, folder: Path, budget: Budget, name: str, methods: Sequence[str]
) -> Iterator[Cell]:
    for file in budget.files:
        for distractor in DISTRACTORS:
            store = zoo_store(data, folder / "stores", file, distractor)
            for method in methods:
                for seed in range(budget.seeds):
                    run = folder / f"robustness-{name}" / file / distractor / f"{method}-{seed}"
                    yield Cell(file, distractor, method, seed, store, run, budget, name)


def _keys(cell: Cell) -> Row:
    return {
        "budget": cell.budget_name,
        "dataset": cell.file,
        "distractor": cell.distractor,
        "method": cell.method,
        "seed": cell.seed,
        "episodes": cell.budget.episodes,
        # As a run's record has it, after JSON.
        "config_hash": config_hash(json.loads(json.dumps(asdict(_config(cell))))),
        "fingerprint": EpisodeStore.open(cell.store).meta["fingerprint"],
    }


def _config(cell: Cell) -> Config:
    policy, own = LEARNERS[cell.learner]
    preset = preset_of(dataset_of(EpisodeStore.open(cell.store)), policy)
    settings = [*cell.budget.settings_of(policy), *own]
    return resolve_config(policy, None, settings, cell.seed, preset.tables)


def _measure(cell: Cell) -> list[Row]:
    store, config = EpisodeStore.open(cell.store), _config(cell)
    record = train_control(store, cell.run, config, screening=SCREENED.get(cell.method))
    # The last checkpoint: the best on validation was chosen where the distractor still tells. Every
    # method plays the same starts, with and without distractor.
    judged = [
        evaluate_run(
            cell.run,
            episodes=cell.budget.episodes,
            seed=1000 + cell.seed,
            targets=preset_of(dataset_of(store), config.policy_name).targets[:1],
            checkpoints=("last",),
            distractor=value,
        )[0]
        for value in ((0.0,) if cell.distractor == CLEAN else (0.0, 1.0))
    ]
    row = {**judged[0], "score_at_one": judged[-1]["score"]}
    if cell.method in SCREENED:
        row["screening"] = verdicts(record["screening"], store)
    losses = held_out_losses(TrainedPolicy.load(cell.run, "last"), store)
    return [row | losses | provenance(PACKAGES)]


@torch.no_grad()
def held_out_losses(trained: TrainedPolicy, store: EpisodeStore) -> Row:
    """Action loss at 4,096 steps of held-out episodes: `loss` with the states as they are logged,
    `loss_at_zero` with every distractor fixed to 0.

    Unlike scores, these do not vary with how episodes happen to end.
    """
    dataset = trained.record["dataset"]
    _, validation = training_views(as_seen(store, dataset))
    generator = np.random.default_rng(0)
    unseen = dataset.get(UNSEEN, [])
    added = [each["dimension"] for each in dataset.get("distractors", [])]
    dimensions = [d - sum(u < d for u in unseen) for d in added if d not in unseen]
    losses = []
    for _ in range(_LOSS_BATCHES):
        steps = validation.draw_steps(generator, _LOSS_BATCH)
        windows = validation.windows(*steps, trained.policy.config.context)
        fixed = windows.states.clone()
        fixed[..., dimensions] = 0.0
        both = (windows, replace(windows, states=fixed))
        losses.append([float(trained.policy.action_loss(each)) for each in both])
    loss, at_zero = np.mean(losses, axis=0)
    return {"loss": float(loss), "loss_at_zero": float(at_zero)}


def drops(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """What every distractor took from a method, where a dataset and seed has a clean row too.

    `clean` and `score` are the normalised scores without and with the distractor, which is fixed to
    0, `drop` the share of `clean` that is lost, in percent: negative where nothing was lost, NaN
    where `clean` is not above 0. `score_at_one` is what the policy of `score` earns, of the same
    starts, where it is fixed to 1. Of rows that say the same, the last counts.

    Args:
        rows: what `robustness` returns, of one budget.
    """
    last = {(r["dataset"], r["method"], r["seed"], r["distractor"]): r for r in rows}
    found = []
    for key, row in last.items():
        plain = last.get((*key[:-1], CLEAN))
        if row["distractor"] == CLEAN or plain is None:
            continue
        clean, score = plain["score"], row["score"]
        lost = 100 * (clean - score) / clean if clean > 0 else float("nan")
        values = (clean, score, lost, row["score_at_one"])
        found.append(
            {name: row[name] for name in ("dataset", "method", "seed", "distractor")}
            | dict(zip(SHOWN, values, strict=True))
        )
    return found


def loss_rises(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Rows with a distractor, and as `rise` by how many percent of `loss` fixing it to 0 raises the
    held-out action loss."""
    return [
        {**row, "rise": 100 * (row["loss_at_zero"] / row["loss"] - 1)}
        for row in rows
        if row["distractor"] != CLEAN
    ]
