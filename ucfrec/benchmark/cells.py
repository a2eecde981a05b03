"""Methods, tasks, budgets, and the cells that a plan makes of them: what tables consist of."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.simulator import Environment
from ucfrec.provenance import config_hash
from ucfrec.results.rows import ResultRow, RowKey, Scalar
from ucfrec.runs.config import Config, resolve_config

Presets = Mapping[str, Mapping[str, Any]]
"""Defaults of settings, by table."""
PAPER_UCF = "ucf-paper"
"""What the names of methods with the paper's settings begin with; a budget shortens their training,
and changes nothing else (`Budget.shorten`)."""
UPDATES = "updates"
"""Detail of their rows: in words, how much of its training they had."""


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
    options: Mapping[str, str] = field(default_factory=dict)
    """What the benchmark itself does in a training, beside the settings of the policy."""

    def supports(self, store: EpisodeStore) -> bool:
        """Whether it can be trained on the actions of `store`."""
        if not store.has_items:
            return self.vectors
        return not self.tags or bool(store.item_states.tags.shape[1])


def make_augmented_ucf(*settings: str, vectors: bool = True) -> Method:
    """UCF with augmented states, and more settings."""
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
        fewer = self.fewer_seeds
        return min(self.seeds, fewer.get(task, self.seeds), fewer.get(method, self.seeds))

    def shorten(self, method: Method, presets: Presets | None = None) -> tuple[str, ...]:
        """Settings of a training that keeps those of a method and its presets but for the number of
        updates, if the budget's is smaller, in proportion that of the warm-up, how often it is
        validated, and the precision."""
        preset = resolve_config(method.policy, presets=presets).train
        values = dict(setting.split("=", 1) for setting in self.settings)
        steps = min(int(values.get("train.steps", preset.steps)), preset.steps)
        warmup = preset.warmup * steps // preset.steps
        prefixes = ("train.validate_every=", "train.precision=")
        settings = tuple(s for s in self.settings if s.startswith(prefixes))
        return (f"train.steps={steps}", f"train.warmup_steps={warmup}", *settings, *method.settings)

    def narrow(
        self,
        tasks: Sequence[str] = (),
        seeds: int | None = None,
        logs: int | None = None,
        evaluation_seed: int | None = None,
    ) -> "Budget":
        """The budget with other tasks, seeds and logs, where they are given."""
        changes: dict[str, Any] = {"logs": logs or self.logs}
        if tasks:
            changes |= {"tasks": tuple(tasks), "tasks_of": {}, "optional": ()}
        if seeds is not None:
            changes |= {"seeds": seeds, "fewer_seeds": {}}
        if evaluation_seed is not None:
            changes["evaluation"] = replace(self.evaluation, seed=evaluation_seed)
        return replace(self, **changes)


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
    """Name of the budget."""
    environments: tuple[Environment, ...] = ()
    log_seed: int | None = None
    training_seed: int | None = None
    """None for a built-in policy, as are `store` and `run`."""
    store: Path | None = None
    run: Path | None = None
    shared: Path | None = None
    """Folder of reward models and augmentation that methods have in common."""
    settings: tuple[str, ...] = ()
    presets: Presets = field(default_factory=dict)
    """Defaults of the training for its data, below `settings`."""
    conditioned: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    """As `Method.options`."""
    conditions: Mapping[str, Scalar] = field(default_factory=dict)
    """Conditions of its rows beside the budget and the number of episodes."""

    @property
    def config(self) -> Config:
        """The resolved configuration of the training."""
        assert self.training_seed is not None
        return resolve_config(self.policy, None, self.settings, self.training_seed, self.presets)


def make_key(cell: Cell) -> RowKey:
    """The key under which the cell's rows are stored; `run_grid` fills in `config_hash`."""
    evaluation: dict[str, Scalar] = {"budget": cell.budget, "episodes": cell.evaluation.episodes}
    same = ("suite", "table", "task", "method", "policy", "training_seed", "log_seed")
    return RowKey(
        **{name: getattr(cell, name) for name in same},
        evaluation_seed=cell.evaluation.seed,
        conditions={**cell.conditions, **evaluation},
        data_fingerprint=None if cell.store is None else open_store(cell).record.fingerprint,
    )


def describe_updates(cell: Cell) -> dict[str, str]:
    """What a row of a method with the paper's settings says of the length of its training."""
    if not cell.method.startswith(PAPER_UCF):
        return {}
    preset = resolve_config(cell.policy, presets=cell.presets).train
    share = 100 * cell.config.train.steps / preset.steps
    return {UPDATES: f"the paper's settings, {share:.2g}% of its updates"}


def training_config(cell: Cell) -> dict[str, Any] | None:
    """The configuration of the cell's training; None for a built-in policy."""
    if cell.store is None:
        return None
    return {**asdict(cell.config), **cell.options}


def open_store(cell: Cell) -> EpisodeStore:
    """The store that the cell is trained on."""
    assert cell.store is not None
    return EpisodeStore.open(cell.store)


@dataclass(frozen=True)
class Measurement:
    """How the cells of a benchmark are measured, by picklable (module-level) functions."""

    measure: Callable[[Cell, RowKey], list[ResultRow]]
    """Measures the cell; returns its rows, all with the given key. Runs with one thread."""
    config: Callable[[Cell], Mapping[str, Any] | None] = training_config
    """Training configuration of the cell; None if nothing is trained."""


@dataclass(frozen=True)
class Plan:
    """Where and by which settings a benchmark trains."""

    suite: str
    """Suite of the rows."""
    folder: Path
    """Where runs and shared stages are kept."""
    budget: Budget
    settings: Callable[[str, Method], tuple[str, ...]]
    """Settings of the training of a method, by its name."""
    presets: Callable[[EpisodeStore, str], Presets] = lambda store, policy: {}
    """Defaults of a policy's training on a store, below the settings."""

    def list_trained(
        self,
        table: str,
        task: Task,
        methods: Mapping[str, Method],
        evaluation: Evaluation | None = None,
        conditions: Mapping[str, Scalar] | None = None,
    ) -> Iterator[Cell]:
        """One cell for each training seed of each method that supports the actions of the task.
        Cells of equal trainings share a run."""
        store, make = EpisodeStore.open(task.store), self._fill(table, task)
        for name, method in methods.items():
            if not method.supports(store):
                continue
            training: dict[str, Any] = {
                "policy": method.policy,
                "settings": self.settings(name, method),
                "presets": self.presets(store, method.policy),
                "options": method.options,
            }
            digest = config_hash({**training, "data": store.record.fingerprint})
            place = folder_name("-".join([task.name, *map(str, task.conditions.values())]))
            run = self.folder / "runs" / place / f"{folder_name(name)}-{digest}"
            for seed in range(self.budget.seeds_of(task.name, name)):
                yield make(
                    method=name,
                    evaluation=evaluation or self.budget.evaluation,
                    log_seed=task.log_seed,
                    training_seed=seed,
                    store=task.store,
                    run=run.with_name(f"{run.name}-{seed}"),
                    shared=self.folder / "stages",
                    conditioned=method.conditioned,
                    conditions={**task.conditions, **(conditions or {})},
                    **training,
                )

    def list_built_in(
        self,
        table: str,
        task: Task,
        methods: Mapping[str, Method],
    ) -> Iterator[Cell]:
        """One cell for each built-in policy of the task's environments, told apart from one of
        `methods` with its name."""
        for name in task.behaviors:
            method = f"{name} (simulator)" if name in methods else name
            yield self._fill(table, task)(
                method=method, policy=name, evaluation=self.budget.evaluation
            )

    def _fill(self, table: str, task: Task) -> partial[Cell]:
        """What all cells of a task in a table have."""
        names: dict[str, Any] = {"suite": self.suite, "table": table, "budget": self.budget.name}
        return partial(Cell, **names, task=task.name, environments=task.environments)


def folder_name(name: str) -> str:
    """The name of a task or method without characters that a path gives a meaning, such as "/"."""
    return re.sub(r"[^\w,.= -]+", "-", name)
