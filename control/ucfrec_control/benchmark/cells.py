"""One cell of the control tables: a training and its result rows."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from ucfrec.code_version import code_version
from ucfrec.episodes.store import EpisodeStore
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import provenance
from ucfrec.reporting.grid import Measurement
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.screened import SCREENING
from ucfrec.runs.shared_stages import OWN, SharedStages
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
"""Suites of the rows."""
TARGET: Final = "target"
"""Condition of rows of budgets with several target returns."""
OF_ITEMS: Final = (
    *("ucfrec.acting.best_items", "ucfrec.user_model.fatigue", "ucfrec.user_model.simulator"),
    *("ucfrec.acting.logged_decisions", "ucfrec.choosing.many_rules"),
    *("ucfrec.acting.session_scorer", "ucfrec.counterfactual.action_copies"),
    *("ucfrec.user_model.reward_effects", "ucfrec.user_model.reward_fit"),
    *("ucfrec.counterfactual.effects_mean", "ucfrec.user_model.reward"),
    *("ucfrec.user_model.reward_report", "ucfrec.user_model.reward_rows"),
    *("ucfrec.user_model.posterior", "ucfrec.user_model.training_users"),
    *("ucfrec.episodes.exposure", "ucfrec.episodes.item_counts", "ucfrec.episodes.item_table"),
    *("ucfrec.user_model.main_tags", "ucfrec.episodes.states", "ucfrec.policies.item_sampling"),
    *("ucfrec.choosing.by_ranking", "ucfrec.choosing.by_simulation"),
)
"""Modules that control imports but does not run, because its actions are vectors: changes to them
change none of its rows."""


@dataclass(frozen=True)
class Cell:
    """One training and its evaluation."""

    suite: str
    table: str
    budget: str
    file: str
    method: str
    learner: str
    """One of `ucfrec.policies.registry.policy_names`, or one of `ALGORITHMS`."""
    settings: tuple[str, ...]
    """Settings over the presets."""
    store: Path
    run: Path
    seed: int
    """Training seed."""
    episodes: int
    evaluation_seed: int
    code_version: str
    rl: Mapping[str, Any] = field(default_factory=dict)
    """Settings of IQL and CQL, as of `rl_config`."""
    distractor: str | None = None
    """A key of `DISTRACTORS`; None outside the robustness suite."""
    screening: str | None = None
    """One of `ucfrec.runs.screened.SCREENINGS`; None for none."""
    all_targets: bool = False
    """As in `Budget`."""
    shared: SharedStages = OWN
    """Reward models and copies that methods have in common."""

    @property
    def config(self) -> Config:
        """The resolved configuration of a sequence policy's training."""
        tables = preset_of(dataset_of(EpisodeStore.open(self.store)), self.learner).tables
        return resolve_config(self.learner, None, self.settings, self.seed, tables)

    @property
    def rl_config(self) -> RLConfig:
        """The configuration of an IQL or CQL training."""
        dataset = dataset_of(EpisodeStore.open(self.store))
        return rl_config(dataset, self.learner, **self.rl)

    @property
    def targets(self) -> Sequence[float]:
        """The target returns of the preset, or the first; empty if the policy knows its own."""
        if self.learner not in ALGORITHMS and self.config.policy.max_return:
            return ()
        found = preset_of(dataset_of(EpisodeStore.open(self.store)), self.learner).targets
        return found if self.all_targets else found[:1]


def code_of(learner: str, *more: str) -> str:
    """The version of the code that a cell of `learner` depends on.

    Args:
        learner: as `Cell.learner`.
        more: further modules that the measurement uses.
    """
    rl = "ucfrec_control.learners.rl_baselines"
    is_rl = learner in ALGORITHMS
    learner_module = rl if is_rl else policy_class(learner).__module__
    parts = ("ucfrec_control.learners.train", "ucfrec_control.learners.evaluate")
    apart = OF_ITEMS if is_rl else (*OF_ITEMS, rl)
    return code_version(__name__, *parts, learner_module, *more, exclude=apart)


def key(cell: Cell) -> RowKey:
    """The key under which the cell's rows are stored."""
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
        data_fingerprint=EpisodeStore.open(cell.store).record.fingerprint,
    )


def config(cell: Cell) -> dict[str, Any]:
    """The configuration of the cell's training, as a run's record has it."""
    if cell.learner in ALGORITHMS:
        return plain_config(cell.rl_config, cell.seed)
    screening = {} if cell.screening is None else {SCREENING: cell.screening}
    return asdict(cell.config) | screening


def measure_scores(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train, and evaluate every kept checkpoint; returns one row for each, and for each target."""
    store = EpisodeStore.open(cell.store)
    if cell.learner in ALGORITHMS:
        train_rl(store, cell.run, cell.rl_config, cell.seed)
    else:
        train_control(store, cell.run, cell.config, shared=cell.shared)
    evaluations = evaluate_run(
        cell.run, episodes=cell.episodes, seed=cell.evaluation_seed, targets=cell.targets
    )
    made = provenance(PACKAGES)
    rows = [score_row(evaluation, row_key, **made) for evaluation in evaluations]
    if not cell.all_targets:
        return rows
    # Rows of one seed that differ in their target are measurements of their own.
    return [replace(r, conditions={**r.conditions, TARGET: r.target_return}) for r in rows]


def measure_robustness(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    """Train with the distractor, and evaluate with it fixed to 0 and to 1; returns one row."""
    store = EpisodeStore.open(cell.store)
    record = train_control(
        store, cell.run, cell.config, screening=cell.screening, shared=cell.shared
    )
    # The last checkpoint: the best one is chosen on data in which the distractor varies.
    # All evaluations have the same initial states, with and without distractor.
    evaluations = [
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
    metrics = {"score_at_one": evaluations[-1]["score"], **losses}
    screening = record.screening
    details = {} if screening is None else {SCREENING: verdicts(screening.dimensions, store)}
    fields = {"metrics": metrics, "details": details}
    return [score_row(evaluations[0], row_key, **fields, **provenance(PACKAGES))]


SCORE_MEASUREMENT: Final = Measurement(key, config, measure_scores)
ROBUSTNESS_MEASUREMENT: Final = Measurement(key, config, measure_robustness)
