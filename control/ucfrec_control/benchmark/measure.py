"""Result rows of a control cell: a training and the scores of its policy."""

import json
from dataclasses import replace
from typing import Any, Final

from ucfrec.benchmark.cells import Cell, Measurement, describe_updates, open_store, training_config
from ucfrec.results.rows import ResultRow, RowKey
from ucfrec.runs.record import RunRecord
from ucfrec_control.benchmark.robustness import verdicts
from ucfrec_control.data.distractor import CLEAN
from ucfrec_control.training.evaluate import evaluate_run
from ucfrec_control.training.rl_baselines import (
    ALGORITHMS,
    RLConfig,
    RLRecord,
    plain_config,
    rl_config,
    train_rl,
)
from ucfrec_control.training.screening import SCREENING, read_screening
from ucfrec_control.training.train import dataset_of, preset_of, train_control

TARGET: Final = "target"
"""Condition of rows of budgets with several target returns."""
DISTRACTOR: Final = "distractor"
"""Condition of rows of the robustness table: a key of `DISTRACTORS`."""
RATE: Final = "learning_rate"
"""Field of a configuration, and condition of rows, that holds a learning rate."""


def config(cell: Cell) -> dict[str, Any] | None:
    """The configuration of the cell's training, as a run's record has it."""
    if cell.policy in ALGORITHMS:
        assert cell.training_seed is not None
        return plain_config(rl_config_of(cell), cell.training_seed)
    return training_config(cell)


def rl_config_of(cell: Cell) -> RLConfig:
    """The configuration of an IQL or CQL training, whose settings are `field=value` in JSON."""
    parts = (setting.partition("=") for setting in cell.settings)
    settings = {name: json.loads(value) for name, _, value in parts}
    return rl_config(dataset_of(open_store(cell)), cell.policy, **settings)


def evaluate(cell: Cell, **how: Any) -> list[ResultRow]:
    """Evaluate the run of the cell at the target returns of the preset, or the first."""
    assert cell.run is not None
    targets = preset_of(dataset_of(open_store(cell)), cell.policy).targets
    if not cell.evaluation.all_targets:
        targets = targets[:1]
    episodes, seed = cell.evaluation.episodes, cell.evaluation.seed
    return evaluate_run(cell.run, episodes=episodes, seed=seed, targets=targets, **how)


def train(cell: Cell) -> RunRecord | RLRecord:
    """Train the policy of the cell; returns the record of its run."""
    assert cell.run is not None
    store = open_store(cell)
    if cell.policy in ALGORITHMS:
        assert cell.training_seed is not None
        return train_rl(store, cell.run, rl_config_of(cell), cell.training_seed)
    screening = cell.options.get(SCREENING)
    return train_control(store, cell.run, cell.config, screening=screening, shared=cell.shared)


def measure_scores(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train, and evaluate every kept checkpoint; returns one row for each, and for each target."""
    train(cell)
    rows = [row.of(row_key).extended(describe_updates(cell)) for row in evaluate(cell)]
    if not cell.evaluation.all_targets:
        return rows
    # Rows of one seed that differ in their target are measurements of their own.
    return [replace(r, conditions={**r.conditions, TARGET: r.target_return}) for r in rows]


def measure_robustness(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train with the distractor, and evaluate with it fixed to 0 and to 1; returns one row."""
    assert cell.run is not None
    record, store = train(cell), open_store(cell)
    # The last checkpoint: the best one is chosen on data in which the distractor varies.
    # All evaluations have the same initial states, with and without distractor.
    values = (0.0,) if cell.conditions[DISTRACTOR] == CLEAN else (0.0, 1.0)
    evaluations = [evaluate(cell, checkpoints=("last",), distractor=v)[0] for v in values]
    more: dict[str, Any] = {"score_at_one": evaluations[-1].value, **describe_updates(cell)}
    if (screening := read_screening(record)) is not None:
        more[SCREENING] = verdicts(screening.dimensions, store)
    return [evaluations[0].of(row_key).extended(more)]


SCORE_MEASUREMENT: Final = Measurement(measure_scores, config)
ROBUSTNESS_MEASUREMENT: Final = Measurement(measure_robustness, config)
