"""Result rows of a cell: a trained method or a built-in policy in the environments of its task."""

from dataclasses import replace
from typing import Any, Final

from ucfrec.benchmark.cells import Cell, Measurement, describe_updates, open_store
from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
from ucfrec.evaluation.simulator import Environment
from ucfrec.files.atomic import claim
from ucfrec.results.rows import ResultRow, RowKey
from ucfrec.runs.record import RunRecord
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.distractor import DistractorEnvironment

CHECKPOINT: Final = "best"


def measure(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train the method, unless it is a built-in policy, and evaluate it in every environment of
    the task.

    It acts by its run's own decision rule, which was chosen on its log, not in an environment.

    Returns:
        One row for each environment, of trained methods with the best validation loss.
    """
    episodes, seed = cell.evaluation.episodes, cell.evaluation.seed
    if cell.run is None:
        return [
            _row(evaluate_behavior(environment, cell.policy, episodes, seed), row_key, environment)
            for environment in cell.environments
        ]
    # Cells that differ only in their evaluation share a run.
    with claim(cell.run, wait=True):
        record = train_run(open_store(cell), cell.run, cell.config, shared=cell.shared)
    training_metrics, rows = _training_metrics(record), []
    trained = TrainedPolicy.load(cell.run, CHECKPOINT)
    rule, quantile = trained.rule, cell.evaluation.target_quantile
    if quantile is not None and cell.conditioned:  # the plan's target
        rule = replace(rule, target=trained.target_return(quantile))
    for environment in cell.environments:
        evaluation = evaluate_policy(environment, trained, cell.method, episodes, seed, rule)
        # Other methods are given a rule, but do not look at its target.
        target = evaluation.target_return if cell.conditioned else None
        row = replace(
            _row(evaluation, row_key, environment),
            checkpoint=CHECKPOINT,
            rule=f"{rule} ({rule.hash})",
            target_return=target,
            details=describe_updates(cell),
        )
        rows.append(row.extended(training_metrics))
    return rows


def _row(measured: ResultRow, row_key: RowKey, environment: Environment) -> ResultRow:
    rate = environment.rate if isinstance(environment, DistractorEnvironment) else None
    row = measured.of(row_key)
    return replace(row, conditions={**row.conditions, "distractor": rate})


def _training_metrics(record: RunRecord) -> dict[str, Any]:
    """Metrics that the run's record holds about its training."""
    metrics: dict[str, Any] = {
        "train_wall_time_s": record.wall_time_s,
        "validation_loss": record.finished.best_validation,
    }
    if record.rule and (of := record.rule.estimate) and not of.doubts:
        metrics |= {"estimated_value": of.value, "estimated_value_error": of.error}
    if (augmentation := record.augmentation) is None:
        return metrics
    return metrics | {
        "acceptance": augmentation.acceptance,
        "crm_r2": augmentation.reward_model.r2,
        "crm_r2_without_z": augmentation.reward_model.r2_without_z,
    }


MEASUREMENT: Final = Measurement(measure)
