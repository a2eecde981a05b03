"""Result rows of a control cell: a training and the scores of its policy."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from ucfrec.benchmark.cells import Cell, measured_by, opened, training_config
from ucfrec.fitting.loop import SILENT
from ucfrec.provenance import provenance
from ucfrec.results.row import ResultRow, RowKey
from ucfrec.runs.record import RunRecord
from ucfrec.runs.screened import SCREENING
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.benchmark.robustness import verdicts
from ucfrec_control.benchmark.spread import AVERAGING, BACK
from ucfrec_control.data.distractor import CLEAN
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.training.evaluate import evaluate_run, held_out_losses
from ucfrec_control.training.kept import WEIGHTS, checkpoint_name, keeping, kept_steps
from ucfrec_control.training.rl_baselines import (
    ALGORITHMS,
    RLConfig,
    RLRecord,
    action_loss,
    plain_config,
    rl_config,
    train_rl,
)
from ucfrec_control.training.train import dataset_of, preset_of, train_control

TARGET: Final = "target"
"""Condition of rows of budgets with several target returns."""
DISTRACTOR: Final = "distractor"
"""Condition of rows of the robustness table: a key of `DISTRACTORS`."""
CONTEXT: Final = "context"
"""Condition of rows of the search for contexts."""
RATE: Final = "learning_rate"
"""Condition of rows of the search for rates."""


def config(cell: Cell) -> dict[str, Any] | None:
    """The configuration of the cell's training, as a run's record has it."""
    if cell.policy in ALGORITHMS:
        return plain_config(rl_config_of(cell), seed_of(cell))
    return training_config(cell)


def rl_config_of(cell: Cell) -> RLConfig:
    """The configuration of an IQL or CQL training, whose settings are `field=value` in JSON."""
    parts = (each.partition("=") for each in cell.settings)
    settings = {name: json.loads(value) for name, _, value in parts}
    return rl_config(dataset_of(opened(cell)), cell.policy, **settings)


def seed_of(cell: Cell) -> int:
    """The training seed, which every control cell has."""
    assert cell.training_seed is not None
    return cell.training_seed


def targets_of(cell: Cell) -> Sequence[float]:
    """The target returns of the preset, or the first; empty if the policy knows its own."""
    if cell.policy not in ALGORITHMS and cell.config.policy.max_return:
        return ()
    found = preset_of(dataset_of(opened(cell)), cell.policy).targets
    return found if cell.evaluation.all_targets else found[:1]


def _train(cell: Cell) -> RunRecord | RLRecord:
    """Train the policy of the cell; returns the record of its run."""
    assert cell.run is not None
    store = opened(cell)
    if cell.policy in ALGORITHMS:
        return train_rl(store, cell.run, rl_config_of(cell), seed_of(cell))
    config = cell.config
    callbacks = keeping(cell.run, config.train) if config.train.average else SILENT
    return train_control(
        *(store, cell.run, config),
        screening=cell.screening,
        shared=cell.shared,
        callbacks=callbacks,
    )


def measure_scores(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train, and evaluate every kept checkpoint; returns one row for each, and for each target."""
    assert cell.run is not None
    _train(cell)
    evaluations = evaluate_run(
        cell.run,
        episodes=cell.evaluation.episodes,
        seed=cell.evaluation.seed,
        targets=targets_of(cell),
    )
    rows = [row.of(row_key) for row in evaluations]
    if not cell.evaluation.all_targets:
        return rows
    # Rows of one seed that differ in their target are measurements of their own.
    return [replace(r, conditions={**r.conditions, TARGET: r.target_return}) for r in rows]


def measure_spread(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train, and evaluate one of the last checkpoints; returns a row of its raw weights and one of
    its averaged ones."""
    assert cell.run is not None
    _train(cell)
    step = kept_steps(cell.config.train)[int(str(cell.conditions[BACK]))]
    rows = []
    for weights in WEIGHTS:
        name = checkpoint_name(weights, step)
        evaluations = evaluate_run(
            cell.run,
            episodes=cell.evaluation.episodes,
            seed=cell.evaluation.seed,
            targets=targets_of(cell),
            checkpoints=(name,),
        )
        losses = held_out_losses(TrainedPolicy.load(cell.run, name), opened(cell))
        more = {"step": step, "loss": losses["loss"]}
        row = evaluations[0].of(row_key).extended(more)
        rows.append(replace(row, conditions={**row.conditions, AVERAGING: weights}))
    return rows


def measure_robustness(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train with the distractor, and evaluate with it fixed to 0 and to 1; returns one row."""
    assert cell.run is not None
    record, store = _train(cell), opened(cell)
    # The last checkpoint: the best one is chosen on data in which the distractor varies.
    # All evaluations have the same initial states, with and without distractor.
    evaluations = [
        evaluate_run(
            cell.run,
            episodes=cell.evaluation.episodes,
            seed=cell.evaluation.seed,
            targets=targets_of(cell),
            checkpoints=("last",),
            distractor=value,
        )[0]
        for value in ((0.0,) if cell.conditions[DISTRACTOR] == CLEAN else (0.0, 1.0))
    ]
    losses = held_out_losses(TrainedPolicy.load(cell.run, "last"), store)
    more: dict[str, Any] = {"score_at_one": evaluations[-1].value, **losses}
    if record.screening is not None:
        more[SCREENING] = verdicts(record.screening.dimensions, store)
    return [evaluations[0].of(row_key).extended(more)]


def measure_rate(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train at a learning rate; returns a row with the validation loss."""
    assert cell.run is not None
    record = _train(cell)
    if isinstance(record, RunRecord):
        loss = record.finished.best_validation
    else:
        loss = action_loss(cell.run, opened(cell))
    row = ResultRow(
        **vars(row_key),
        metric="validation_loss",
        metrics={"validation_loss": loss, "steps": float(record.finished.steps)},
        wall_time_s=record.wall_time_s,
        **provenance(PACKAGES),
    )
    return [row]


SCORE_MEASUREMENT: Final = measured_by(measure_scores, config)
SPREAD_MEASUREMENT: Final = measured_by(measure_spread, config)
ROBUSTNESS_MEASUREMENT: Final = measured_by(measure_robustness, config)
RATE_MEASUREMENT: Final = measured_by(measure_rate, config)
