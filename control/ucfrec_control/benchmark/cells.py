"""One cell of the control tables: a training, and the rows it gives."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import provenance
from ucfrec.reporting.grid import Measurement
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.benchmark.score_rows import score_row
from ucfrec_control.benchmark.screening_table import verdicts
from ucfrec_control.data.distractor import CLEAN
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.learners.evaluate import evaluate_run
from ucfrec_control.learners.held_out_losses import held_out_losses
from ucfrec_control.learners.rl_baselines import (
    ALGORITHMS,
    RLConfig,
    plain_config,
    rl_config,
    train_rl,
)
from ucfrec_control.learners.train import dataset_of, preset_of, train_control

SCORES, ROBUSTNESS = "control", "robustness"
"""The suites."""
_RULE: Final = "target return: the first of the preset"


@dataclass(frozen=True)
class Cell:
    """One training, and the rows it gives."""

    suite: str
    table: str
    budget: str
    file: str
    method: str
    learner: str
    """One of `ucfrec.policies.registry.policy_names`, or one of `ALGORITHMS`."""
    settings: tuple[str, ...]
    """Over the presets."""
    store: Path
    run: Path
    seed: int
    """Of the training."""
    episodes: int
    evaluation_seed: int
    code_version: str
    rl_steps: int = 0
    rl_batch_size: int = 0
    """Of IQL and CQL."""
    distractor: str | None = None
    """A key of `DISTRACTORS`, of the robustness suite."""
    screening: str | None = None
    """As in `train_control`."""

    @property
    def config(self) -> Config:
        """All that decides the training of a sequence policy, with its data."""
        tables = preset_of(dataset_of(EpisodeStore.open(self.store)), self.learner).tables
        return resolve_config(self.learner, None, self.settings, self.seed, tables)

    @property
    def rl_config(self) -> RLConfig:
        """The same of IQL and CQL."""
        dataset = dataset_of(EpisodeStore.open(self.store))
        return rl_config(dataset, self.learner, self.rl_steps, self.rl_batch_size)

    @property
    def targets(self) -> Sequence[float]:
        """The return that the policy is given."""
        return preset_of(dataset_of(EpisodeStore.open(self.store)), self.learner).targets[:1]


def code_of(learner: str, *more: str) -> str:
    """The version of the code that a cell of `learner` runs through.

    Args:
        more: modules that the measurement uses beside training and evaluation.
    """
    rl = "ucfrec_control.learners.rl_baselines"
    is_rl = learner in ALGORITHMS
    own = rl if is_rl else policy_class(learner).__module__
    parts = ("ucfrec_control.learners.train", "ucfrec_control.learners.evaluate")
    return code_version(__name__, *parts, own, *more, exclude=() if is_rl else (rl,))


def key(cell: Cell) -> RowKey:
    """What tells the cell's rows from others."""
    conditions: dict[str, str | int] = {"budget": cell.budget, "episodes": cell.episodes}
    if cell.distractor is not None:
        conditions["distractor"] = cell.distractor
    return RowKey(
        suite=cell.suite,
        table=cell.table,
        task=cell.file,
        method=cell.method,
        policy=cell.learner,
        training_seed=cell.seed,
        evaluation_seed=cell.evaluation_seed,
        conditions=conditions,
        code_version=cell.code_version,
        data_fingerprint=EpisodeStore.open(cell.store).meta["fingerprint"],
    )


def config(cell: Cell) -> dict[str, Any]:
    """The configuration of the cell's training, as a run's record has it."""
    if cell.learner in ALGORITHMS:
        return plain_config(cell.rl_config, cell.seed)
    return asdict(cell.config)


def measure_scores(cell: Cell, own: RowKey) -> list[ResultRow]:
    """Train, and evaluate every checkpoint that is kept."""
    store = EpisodeStore.open(cell.store)
    if cell.learner in ALGORITHMS:
        train_rl(store, cell.run, cell.rl_config, cell.seed)
    else:
        train_control(store, cell.run, cell.config)
    found = evaluate_run(
        cell.run, episodes=cell.episodes, seed=cell.evaluation_seed, targets=cell.targets
    )
    return [score_row(row, own, rule=_RULE, **provenance(PACKAGES)) for row in found]


def measure_robustness(cell: Cell, own: RowKey) -> list[ResultRow]:
    """Train with the distractor, and evaluate where it is fixed to 0 and to 1."""
    store = EpisodeStore.open(cell.store)
    record = train_control(store, cell.run, cell.config, screening=cell.screening)
    # The last checkpoint: the best on validation was chosen where the distractor still varies.
    # Every method plays the same starts, with and without distractor.
    found = [
        evaluate_run(
            cell.run,
            episodes=cell.episodes,
            seed=cell.evaluation_seed,
            targets=cell.targets,
            checkpoints=("last",),
            distractor=value,
        )[0]
        for value in ((0.0,) if cell.distractor == CLEAN else (0.0, 1.0))
    ]
    losses = held_out_losses(TrainedPolicy.load(cell.run, "last"), store)
    metrics = {"score_at_one": found[-1]["score"], **losses}
    details = {"screening": verdicts(record["screening"], store)} if cell.screening else {}
    given = {"metrics": metrics, "details": details, "rule": _RULE}
    return [score_row(found[0], own, **given, **provenance(PACKAGES))]


SCORE_MEASUREMENT: Final = Measurement(key, config, measure_scores)
ROBUSTNESS_MEASUREMENT: Final = Measurement(key, config, measure_robustness)
