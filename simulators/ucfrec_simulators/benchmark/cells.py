"""One cell of the tables, a method trained on a task or a built-in policy, and its rows."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.evaluate import evaluate_behavior, evaluate_policy
from ucfrec.evaluation.world import World
from ucfrec.provenance import config_hash
from ucfrec.reporting.grid import Row
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_simulators.distractor import DistractorWorld

CHECKPOINTS: Final = ("best", "last")
JUDGED, VALIDATED = 1_000_000, 2_000_000
"""Added to a training seed: for sessions that are reported, and for those that choose a target."""


@dataclass(frozen=True)
class Method:
    """A row of a table."""

    policy: str
    """One of `ucfrec.policies.registry.policy_names`."""
    settings: tuple[str, ...] = ()
    conditioned: bool = True
    """Whether it is asked for a return."""
    vectors: bool = True
    """Whether it also acts where actions are vectors."""


METHODS: Final[Mapping[str, Method]] = {
    "popular": Method("popular", conditioned=False),
    "item-knn": Method("item-knn", conditioned=False, vectors=False),
    "sasrec": Method("sasrec", conditioned=False),
    "bc": Method("bc", conditioned=False),
    "bc-25": Method("bc", ("policy.best_share=0.25",), conditioned=False),
    "bc-10": Method("bc", ("policy.best_share=0.1",), conditioned=False),
    "crm-greedy": Method("crm-greedy", conditioned=False),
    "dt": Method("dt"),
    "dt4rec": Method("dt4rec"),
    "cdt4rec": Method("cdt4rec"),
    "edt4rec": Method("edt4rec"),
    "ucf-wo-count": Method("ucf", ("augment.copies=0",)),
    "ucf-wo-arch": Method("dt", ("augment.copies=1",)),
    "ucf": Method("ucf"),
}
"""By the name in the tables; the last but two to one are the ablations of the paper's Table 3."""


@dataclass(frozen=True)
class Judging:
    """How trained policies are judged."""

    episodes: int
    validation_episodes: int
    """Played to choose the target return; never reported as a result."""
    quantiles: tuple[float, ...]
    """Of the training returns: the targets to choose from, where there are several."""


@dataclass(frozen=True)
class Cell:
    """What gives the rows of one method, in one task, from one seed."""

    task: str
    method: str
    seed: int
    worlds: tuple[World, ...]
    judging: Judging
    store: Path | None = None
    """What is learned from; None for a built-in policy of the worlds."""
    run: Path | None = None
    policy: str = ""
    settings: tuple[str, ...] = ()
    conditioned: bool = False

    @property
    def config(self) -> Config:
        """All that decides the training, with its data."""
        return resolve_config(self.policy, None, self.settings, self.seed)


def keys(cell: Cell) -> dict[str, Any]:
    """What tells the cell's rows from others."""
    own = {"task": cell.task, "method": cell.method, "seed": cell.seed}
    own |= {"episodes": cell.judging.episodes}
    if cell.store is None:
        return own
    plain = json.loads(json.dumps(asdict(cell.config)))
    fingerprint = EpisodeStore.open(cell.store).meta["fingerprint"]
    own |= {"config": config_hash(plain), "fingerprint": fingerprint}
    return own | {"quantiles": list(cell.judging.quantiles)}


def measure(cell: Cell) -> list[Row]:
    """Train where there is something to train, and judge in every world of the task.

    The target return of a conditioned method is the one, of a few quantiles of the training
    returns, that earned most in other sessions than those reported.
    """
    episodes, seed = cell.judging.episodes, cell.seed + JUDGED
    rows = []
    if cell.store is None or cell.run is None:
        for world in cell.worlds:
            row = evaluate_behavior(world, cell.method, episodes, seed)
            rows.append(_named(row, world, None))
        return rows
    record = train_run(EpisodeStore.open(cell.store), cell.run, cell.config)
    for world in cell.worlds:
        chosen, tried = _target(cell, world)
        for checkpoint in CHECKPOINTS:
            trained = TrainedPolicy.load(cell.run, checkpoint)
            row = evaluate_policy(world, trained, cell.method, episodes, seed, chosen)
            rows.append(_named(row, world, checkpoint) | {"validation": tried, **_learned(record)})
    return rows


def _named(row: Row, world: World, checkpoint: str | None) -> Row:
    """The row, its keys those of a benchmark: `seed` is the training's."""
    distractor = world.rate if isinstance(world, DistractorWorld) else None
    own = {"env": row["world"], "distractor": distractor, "checkpoint": checkpoint}
    return row | own | {"evaluation_seed": row["seed"]}


def _learned(record: Mapping[str, Any]) -> Row:
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


def _target(cell: Cell, world: World) -> tuple[float, dict[str, float] | None]:
    """The target that earns most on validation seeds, and what each earned there."""
    assert cell.run is not None
    trained = TrainedPolicy.load(cell.run)
    if not cell.conditioned:
        return trained.target_return(1.0), None
    targets = dict.fromkeys(trained.target_return(q) for q in cell.judging.quantiles)
    if len(targets) == 1:
        return next(iter(targets)), None
    count, seed = cell.judging.validation_episodes, cell.seed + VALIDATED
    tried = {
        target: float(evaluate_policy(world, trained, cell.method, count, seed, target)["R_cum"])
        for target in targets
    }
    return max(tried, key=lambda target: tried[target]), {f"{t:g}": r for t, r in tried.items()}
