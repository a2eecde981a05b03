"""Methods, tasks, budgets and cells: what the tables of a benchmark are made of."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ucfrec.benchmark.grid import Measurement
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Environment
from ucfrec.results.rows import ResultRow, RowKey, Scalar
from ucfrec.runs.config import Config, resolve_config
from ucfrec.runs.screened import SCREENING
from ucfrec.runs.shared_stages import OWN, SharedStages


@dataclass(frozen=True)
class Method:
    """A policy and its settings: one line of a table."""

    policy: str
    """One of `ucfrec.policies.registry.policy_names`, or one that the benchmark itself trains."""
    settings: tuple[str, ...] = ()
    """Settings over the defaults, as for `--set`."""
    conditioned: bool = True
    """Whether it takes a target return."""
    vectors: bool = True
    """Whether it also supports action vectors; False for policies of items only."""
    tags: bool = False
    """Whether it supports only items with tags."""
    screening: str | None = None
    """One of `ucfrec.runs.screened.SCREENINGS` for logs with observations; None for none."""

    def supports(self, store: EpisodeStore) -> bool:
        """Whether it can be trained on the actions of `store`."""
        if not store.has_items:
            return self.vectors
        return not self.tags or bool(store.item_states.tags.shape[1])


def augmented_ucf(*settings: str, vectors: bool = True) -> Method:
    """UCF with augmented states, as in the paper's tables, and more settings."""
    return Method("ucf", ("augment.copies=1", *settings), vectors=vectors)


@dataclass(frozen=True)
class Task:
    """A log to train on, and the environments to evaluate in."""

    name: str
    store: Path
    """Episode store that methods are trained on."""
    environments: tuple[Environment, ...] = ()
    """Empty where the data name their environment."""
    behaviors: tuple[str, ...] = ()
    """Built-in policies of the environments that are evaluated as references."""
    log_seed: int | None = None
    """Seed of a simulated log, or number of the part of a given log; None for all of it."""
    conditions: Mapping[str, Scalar] = field(default_factory=dict)
    """Conditions of its rows, e.g. the distractor in its log."""


@dataclass(frozen=True)
class Evaluation:
    """How policies are evaluated."""

    episodes: int
    """Episodes of each reported result."""
    seed: int
    """Seed of the reported episodes; the same for all training seeds and methods."""
    target_quantile: float | None = None
    """Quantile of the training returns that every conditioned method is given as target; None for
    the target of each run's own rule."""
    all_targets: bool = False
    """Whether a policy is given every target return of its preset, or the first."""


@dataclass(frozen=True)
class Budget:
    """The size of a benchmark."""

    name: str
    tasks: tuple[str, ...]
    seeds: int
    """Training seeds, but of `fewer_seeds`."""
    evaluation: Evaluation
    settings: tuple[str, ...] = ()
    """Settings of all methods, over their defaults or presets."""
    of_policies: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Further settings of single policies, by name."""
    of_methods: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Further settings of single methods, by name; they win over the method's own."""
    methods: tuple[str, ...] = ()
    """Methods that are measured where none are named; empty for all of the table."""
    fewer_seeds: Mapping[str, int] = field(default_factory=dict)
    """Training seeds of methods and tasks that have fewer, by name."""
    seeds_in: Mapping[str, int] = field(default_factory=dict)
    """Training seeds of tables that have others than `seeds`."""
    tasks_of: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Tasks of tables that have others than `tasks`."""
    optional: tuple[str, ...] = ()
    """Those of `tasks` that are excluded where their data is missing."""
    logs: int = 1
    """Logs of every task: simulated ones of as many seeds, or parts of a given log."""
    sessions: int = 0
    """Sessions collected where logs are simulated."""

    def tasks_in(self, table: str) -> tuple[str, ...]:
        """The tasks of a table."""
        return self.tasks_of.get(table, self.tasks)

    def seeds_of(self, task: str, method: str) -> int:
        """The number of training seeds of a method on a task."""
        fewer = (self.fewer_seeds.get(name, self.seeds) for name in (task, method))
        return min(self.seeds, *fewer)

    def narrowed(
        self,
        tasks: Sequence[str] = (),
        seeds: int | None = None,
        logs: int | None = None,
        evaluation_seed: int | None = None,
    ) -> "Budget":
        """The budget with other tasks, seeds and logs, where they are given.

        Raises:
            InputError: `seeds` or `logs` is below 1.
        """
        for name, number in (("training seeds", seeds), ("logs", logs)):
            if number is not None and number < 1:
                raise InputError(f"{number} {name} are requested; at least one is needed")
        evaluation = self.evaluation
        if evaluation_seed is not None:
            evaluation = replace(evaluation, seed=evaluation_seed)
        return replace(
            self,
            tasks=tuple(tasks) or self.tasks,
            tasks_of={} if tasks else self.tasks_of,
            optional=() if tasks else self.optional,
            seeds=self.seeds if seeds is None else seeds,
            fewer_seeds=self.fewer_seeds if seeds is None else {},
            logs=self.logs if logs is None else logs,
            evaluation=evaluation,
        )


@dataclass(frozen=True)
class Cell:
    """One method on one task with one training seed: a training and its evaluation."""

    suite: str
    table: str
    task: str
    method: str
    """Name of the method, as the table shows it."""
    policy: str
    """As `Method.policy`, or a built-in policy of the environments."""
    evaluation: Evaluation
    budget: str = ""
    """Name of the budget; "" for what has no training and no evaluation."""
    environments: tuple[Environment, ...] = ()
    log_seed: int | None = None
    training_seed: int | None = None
    """None for a built-in policy, as are `store` and `run`."""
    store: Path | None = None
    run: Path | None = None
    shared: SharedStages = OWN
    """Reward models and augmentation that methods have in common."""
    settings: tuple[str, ...] = ()
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Defaults of the training for its data, below `settings`."""
    conditioned: bool = False
    screening: str | None = None
    conditions: Mapping[str, Scalar] = field(default_factory=dict)
    """Conditions of its rows beside the budget and the number of episodes."""

    @property
    def config(self) -> Config:
        """The resolved configuration of the training."""
        assert self.training_seed is not None
        return resolve_config(self.policy, None, self.settings, self.training_seed, self.presets)


def key(cell: Cell) -> RowKey:
    """The key under which the cell's rows are stored."""
    conditions: dict[str, Scalar] = {**cell.conditions}
    if cell.budget:
        conditions |= {"budget": cell.budget, "episodes": cell.evaluation.episodes}
    return RowKey(
        suite=cell.suite,
        table=cell.table,
        task=cell.task,
        method=cell.method,
        policy=cell.policy,
        training_seed=cell.training_seed,
        log_seed=cell.log_seed,
        evaluation_seed=cell.evaluation.seed,
        conditions=conditions,
        data_fingerprint=None if cell.store is None else opened(cell).record.fingerprint,
    )


def training_config(cell: Cell) -> dict[str, Any] | None:
    """The configuration of the cell's training; None for a built-in policy."""
    if cell.store is None:
        return None
    screening = {} if cell.screening is None else {SCREENING: cell.screening}
    return asdict(cell.config) | screening


def measured_by(
    measure: Callable[[Cell, RowKey], list[ResultRow]],
    config: Callable[[Cell], Mapping[str, Any] | None] = training_config,
) -> Measurement[Cell]:
    """How cells are measured by `measure`, whose training has the configuration `config`."""
    return Measurement(key, config, measure, made)


def made(cell: Cell) -> list[Path]:
    """Folders of the cell's run and of the stages that it shares."""
    return [folder for folder in (cell.run, cell.shared.folder) if folder is not None]


def opened(cell: Cell) -> EpisodeStore:
    """The store that the cell is trained on."""
    assert cell.store is not None
    return EpisodeStore.open(cell.store)
