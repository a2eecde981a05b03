"""One cell of the tables (a trained method or a built-in policy on a task) and its result rows."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.environment import Environment
from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
from ucfrec.files.locks import claim
from ucfrec.reporting.evaluation_rows import evaluation_row
from ucfrec.reporting.grid import Measurement
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.screened import SCREENING, train_screened
from ucfrec.runs.shared_stages import OWN, SharedStages
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.distractor import DistractorEnvironment

SUITE: Final = "recommendation"
CHECKPOINT: Final = "best"


@dataclass(frozen=True)
class EvaluationPlan:
    """How policies are evaluated."""

    episodes: int
    """Episodes of each reported result."""
    target_quantile: float | None = None
    """Quantile of the training returns that every conditioned method is given as target; None for
    the target of each run's own rule."""
    seed: int = 1_000_000
    """Seed of the reported episodes; the same for all training seeds."""


@dataclass(frozen=True)
class Cell:
    """One method on one benchmark task with one training seed."""

    table: str
    budget: str
    task: str
    method: str
    policy: str
    """One of `ucfrec.policies.registry.policy_names`, or a built-in policy of the environments."""
    environments: tuple[Environment, ...]
    evaluation: EvaluationPlan
    code_version: str
    log_seed: int | None
    """Seed of a simulated log, or number of the part of a given log; None for all of it."""
    training_seed: int | None = None
    """None for a built-in policy, as are `store` and `run`."""
    store: Path | None = None
    """Episode store that the method is trained on."""
    run: Path | None = None
    """Run folder."""
    shared: SharedStages = OWN
    """Reward models and copies that methods have in common."""
    settings: tuple[str, ...] = ()
    """Settings of the training, as for `--set`."""
    conditioned: bool = False
    """Whether the method takes a target return."""
    screening: str | None = None
    """As in `ucfrec.runs.screened.train_screened`."""

    @property
    def config(self) -> Config:
        """The resolved configuration of the training."""
        assert self.training_seed is not None
        return resolve_config(self.policy, None, self.settings, self.training_seed)


def key(cell: Cell) -> RowKey:
    """The key under which the cell's rows are stored."""
    conditions: dict[str, str | int] = {
        "budget": cell.budget,
        "episodes": cell.evaluation.episodes,
    }
    fingerprint = None
    if cell.store is not None:
        quantile = cell.evaluation.target_quantile
        conditions["quantiles"] = "rule" if quantile is None else f"{quantile:g}"
        fingerprint = EpisodeStore.open(cell.store).record.fingerprint
    return RowKey(
        suite=SUITE,
        table=cell.table,
        task=cell.task,
        method=cell.method,
        policy=cell.policy,
        training_seed=cell.training_seed,
        log_seed=cell.log_seed,
        evaluation_seed=cell.evaluation.seed,
        conditions=conditions,
        code_version=cell.code_version,
        data_fingerprint=fingerprint,
    )


def measure(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train the method, unless it is a built-in policy, and evaluate it in every environment of
    the task.

    It acts by its run's own decision rule, which was chosen on its log, not in an environment.

    Args:
        cell: what to train and evaluate.
        row_key: key of the rows.

    Returns:
        One row for each environment, of trained methods with the best validation loss.
    """
    episodes, seed = cell.evaluation.episodes, cell.evaluation.seed
    if cell.store is None or cell.run is None:
        return [
            _row(evaluate_behavior(environment, cell.policy, episodes, seed), row_key, environment)
            for environment in cell.environments
        ]
    # Cells that differ only in their evaluation share a run.
    with claim(cell.run, wait=True):
        store = EpisodeStore.open(cell.store)
        record = train_screened(store, cell.run, cell.config, cell.screening, shared=cell.shared)
    training_metrics, rows = _training_metrics(record), []
    details = {} if record.screening is None else {SCREENING: record.screening.flagged}
    trained = TrainedPolicy.load(cell.run, CHECKPOINT)
    rule = _rule(cell, trained)
    for environment in cell.environments:
        metrics = evaluate_policy(environment, trained, cell.method, episodes, seed, rule)
        fields = {"checkpoint": CHECKPOINT, "rule": f"{rule} ({rule.hash})"}
        row = _row(metrics | training_metrics, row_key, environment, **fields)
        # Other methods are given a rule, but do not look at its target.
        target = row.target_return if cell.conditioned else None
        rows.append(replace(row, details={**row.details, **details}, target_return=target))
    return rows


def _row(
    metrics: Mapping[str, Any], row_key: RowKey, environment: Environment, **fields: Any
) -> ResultRow:
    row = evaluation_row(metrics, row_key, **fields)
    distractor = environment.rate if isinstance(environment, DistractorEnvironment) else None
    return ResultRow(**vars(row) | {"conditions": {**row.conditions, "distractor": distractor}})


def _training_metrics(record: RunRecord) -> dict[str, float]:
    """Metrics that the run's record holds about its training."""
    metrics = {
        "train_wall_time_s": record.wall_time_s,
        "validation_loss": record.finished.best_validation,
    }
    if record.rule is not None and (value := record.rule.simulated) is not None:
        metrics |= {"promised": value[0], "promised_error": value[1]}
    if (augmentation := record.augmentation) is None:
        return metrics
    model = augmentation.reward_model
    return metrics | {
        "acceptance": augmentation.acceptance,
        "crm_r2": model.r2,
        "crm_r2_without_z": model.r2_without_z,
    }


def _rule(cell: Cell, trained: TrainedPolicy) -> DecisionRule:
    """The run's own rule, or with the plan's target."""
    quantile = cell.evaluation.target_quantile
    if quantile is None or not cell.conditioned:
        return trained.rule
    return replace(trained.rule, target=trained.target_return(quantile))


def config(cell: Cell) -> dict[str, Any] | None:
    """The configuration of the cell's training; None for a built-in policy."""
    if cell.store is None:
        return None
    screening = {} if cell.screening is None else {SCREENING: cell.screening}
    return asdict(cell.config) | screening


MEASUREMENT: Final = Measurement(key, config, measure)
