"""One cell of the tables, a method trained on a task or a built-in policy, and its rows."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
from ucfrec.evaluation.world import World
from ucfrec.files import file_lock
from ucfrec.reporting.evaluation_rows import evaluation_row
from ucfrec.reporting.grid import Measurement
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.distractor import DistractorWorld

SUITE: Final = "recommendation"
CHECKPOINTS: Final = ("best", "last")


@dataclass(frozen=True)
class EvaluationPlan:
    """How policies are evaluated."""

    episodes: int
    validation_episodes: int
    """Played to choose the target return; never reported as a result."""
    quantiles: tuple[float, ...]
    """Of the training returns: the targets to choose from, where there are several."""
    seed: int = 1_000_000
    """Of the episodes that are reported; the same for all training seeds."""
    validation_seed: int = 2_000_000
    """Of those that choose a target."""


@dataclass(frozen=True)
class Cell:
    """What gives the rows of one method, in one task, from one training seed."""

    table: str
    budget: str
    task: str
    method: str
    policy: str
    """One of `ucfrec.policies.registry.policy_names`, or a built-in policy of the worlds."""
    worlds: tuple[World, ...]
    evaluation: EvaluationPlan
    code_version: str
    log_seed: int | None
    """Of the logs, where they are simulated."""
    training_seed: int | None = None
    """None, as are the next two, for a built-in policy of the worlds."""
    store: Path | None = None
    """What is learned from."""
    run: Path | None = None
    settings: tuple[str, ...] = ()
    conditioned: bool = False

    @property
    def config(self) -> Config:
        """All that decides the training, with its data."""
        assert self.training_seed is not None
        return resolve_config(self.policy, None, self.settings, self.training_seed)


def key(cell: Cell) -> RowKey:
    """What tells the cell's rows from others."""
    conditions: dict[str, str | int] = {
        "budget": cell.budget,
        "episodes": cell.evaluation.episodes,
    }
    fingerprint = None
    if cell.store is not None:
        conditions["quantiles"] = quantile_names(cell.evaluation.quantiles)
        fingerprint = EpisodeStore.open(cell.store).meta["fingerprint"]
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


def quantile_names(quantiles: tuple[float, ...]) -> str:
    """The quantiles of a plan, as a row's conditions have them: "0.5 0.9"."""
    return " ".join(f"{quantile:g}" for quantile in quantiles)


def measure(cell: Cell, own: RowKey) -> list[ResultRow]:
    """Train where there is something to train, and evaluate in every world of the task.

    The target return of a conditioned method is the one, of a few quantiles of the training
    returns, that earned most in other sessions than those reported.
    """
    episodes, seed = cell.evaluation.episodes, cell.evaluation.seed
    if cell.store is None or cell.run is None:
        return [
            _row(evaluate_behavior(world, cell.policy, episodes, seed), own, world)
            for world in cell.worlds
        ]
    # Cells that differ in their evaluation alone share a run.
    with file_lock(cell.run.with_name(f".{cell.run.name}.lock")):
        record = train_run(EpisodeStore.open(cell.store), cell.run, cell.config)
    learned, rows = _learned(record), []
    for world in cell.worlds:
        target, tried = _target(cell, world)
        rule = _rule(cell, tried)
        for checkpoint in CHECKPOINTS:
            trained = TrainedPolicy.load(cell.run, checkpoint)
            found = evaluate_policy(world, trained, cell.method, episodes, seed, target)
            details = {"validation": tried} if tried else {}
            more = {"checkpoint": checkpoint, "rule": rule, "details": details}
            rows.append(_row(found | learned, own, world, **more))
    return rows


def _row(found: Mapping[str, Any], own: RowKey, world: World, **more: Any) -> ResultRow:
    row = evaluation_row(found, own, **more)
    distractor = world.rate if isinstance(world, DistractorWorld) else None
    return ResultRow(**vars(row) | {"conditions": {**row.conditions, "distractor": distractor}})


def _learned(record: Mapping[str, Any]) -> dict[str, float]:
    """What the training reports of itself."""
    about = {
        "train_wall_time_s": record["wall_time_s"],
        "validation_loss": record["policy"]["best_validation"],
    }
    if "augmentation" not in record:
        return about
    augmentation = record["augmentation"]
    model = augmentation["reward_model"]
    return about | {
        "acceptance": augmentation["acceptance"],
        "crm_r2": model["r2"],
        "crm_r2_without_z": model["r2_without_z"],
    }


def _rule(cell: Cell, tried: Mapping[str, float] | None) -> str:
    """How the policy's target return was chosen."""
    if not cell.conditioned:
        return "no target return"
    if tried is None:
        return f"target return: quantile {quantile_names(cell.evaluation.quantiles)} of training"
    plan = cell.evaluation
    return f"target return: best of {len(tried)} in {plan.validation_episodes} other episodes"


def _target(cell: Cell, world: World) -> tuple[float, dict[str, float] | None]:
    """The target that earns most on the validation seed, and what each earned there."""
    assert cell.run is not None
    trained, plan = TrainedPolicy.load(cell.run), cell.evaluation
    if not cell.conditioned:
        return trained.target_return(1.0), None
    targets = dict.fromkeys(trained.target_return(q) for q in plan.quantiles)
    if len(targets) == 1:
        return next(iter(targets)), None
    given = (plan.validation_episodes, plan.validation_seed)
    tried = {
        target: float(evaluate_policy(world, trained, cell.method, *given, target)["R_cum"])
        for target in targets
    }
    return max(tried, key=lambda target: tried[target]), {f"{t:g}": r for t, r in tried.items()}


def config(cell: Cell) -> dict[str, Any] | None:
    """The configuration of the cell's training, if it has one."""
    return None if cell.store is None else asdict(cell.config)


MEASUREMENT: Final = Measurement(key, config, measure)
