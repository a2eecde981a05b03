"""The cells of methods on a task, at a budget."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ucfrec.benchmark.cells import Budget, Cell, Evaluation, Method, Task
from ucfrec.episodes.store import EpisodeStore
from ucfrec.provenance import config_hash
from ucfrec.results.rows import Scalar
from ucfrec.runs.shared_stages import SharedStages

Presets = Mapping[str, Mapping[str, Any]]


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

    def trained(
        self,
        table: str,
        task: Task,
        methods: Mapping[str, Method],
        evaluation: Evaluation | None = None,
        conditions: Mapping[str, Scalar] | None = None,
    ) -> Iterator[Cell]:
        """One cell for each training seed of each method that supports the actions of the task.

        Cells of equal trainings share a run.

        Args:
            evaluation: None for the budget's.
        """
        store = EpisodeStore.open(task.store)
        for name, method in methods.items():
            if not method.supports(store):
                continue
            settings = self.settings(name, method)
            presets = self.presets(store, method.policy)
            # Where nothing but items was logged, there are no columns to screen.
            screening = method.screening if store.observation_size else None
            training = {
                "policy": method.policy,
                "settings": settings,
                "presets": presets,
                "screening": screening,
                "data": store.record.fingerprint,
            }
            run = f"{folder_name(name)}-{config_hash(training)}"
            place = folder_name("-".join([task.name, *map(str, task.conditions.values())]))
            for seed in range(self.budget.seeds_of(task.name, name)):
                yield Cell(
                    suite=self.suite,
                    table=table,
                    budget=self.budget.name,
                    task=task.name,
                    method=name,
                    policy=method.policy,
                    environments=task.environments,
                    evaluation=evaluation or self.budget.evaluation,
                    log_seed=task.log_seed,
                    training_seed=seed,
                    store=task.store,
                    run=self.folder / "runs" / place / f"{run}-{seed}",
                    shared=SharedStages(self.folder / "stages"),
                    settings=settings,
                    presets=presets,
                    conditioned=method.conditioned,
                    screening=screening,
                    conditions={**task.conditions, **(conditions or {})},
                )

    def built_in(self, table: str, task: Task, methods: Mapping[str, Method]) -> Iterator[Cell]:
        """One cell for each built-in policy of the task's environments.

        Args:
            methods: of the table; a built-in policy of the same name is distinguished from it.
        """
        for name in task.behaviors:
            yield Cell(
                suite=self.suite,
                table=table,
                budget=self.budget.name,
                task=task.name,
                method=f"{name} (simulator)" if name in methods else name,
                policy=name,
                environments=task.environments,
                evaluation=self.budget.evaluation,
            )


def folder_name(name: str) -> str:
    """The name of a task or method without characters that a path gives a meaning, such as "/"."""
    return re.sub(r"[^\w,.= -]+", "-", name)
