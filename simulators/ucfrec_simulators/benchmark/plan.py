"""Which cells each table of the recommendation benchmark has."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import product
from typing import Final

from ucfrec import schema
from ucfrec.benchmark.cells import Budget, Cell, Method, Plan, Task, folder_name, make_augmented_ucf
from ucfrec.benchmark.suite import BenchmarkRequest
from ucfrec.episodes.store import EpisodeStore
from ucfrec_simulators import sardine
from ucfrec_simulators.benchmark import tasks
from ucfrec_simulators.benchmark.methods import (
    COMPONENTS,
    DISTRACTED,
    METHODS,
    PAPER,
    SHARED_TASKS,
    SWEPT,
)
from ucfrec_simulators.benchmark.tasks import TASKS, Log
from ucfrec_simulators.distractor import OFF, ON, DistractorEnvironment, plant_distractor
from ucfrec_simulators.session_env import data_folder

SUITE: Final = "recommendation"
LAMBDAS: Final = (0.0, 0.1, 0.5, 1.0)
BANDS: Final = ((0.05, 0.2), (1.0, 2.0))
GATES: Final = (0.02, 1e6)
"""ε_r in standard deviations of the rewards; the last value disables the gate. The first λ is the
default, and the line to compare with."""
DISTRACTOR_METHODS: Final[Mapping[str, Method]] = {
    name: METHODS[name] for name in ("bc", "dt", *PAPER, "ucf")
}
DISTRACTOR_TARGETS: Final = (1.0, 0.99)
"""Quantiles of the training returns: the default target, and one nearer to the logs."""
_TASKS_OF: Final = {"shared": SHARED_TASKS, "sweeps": SWEPT, "distractor": tuple(DISTRACTED)}
"""All tasks that a table can have, which `--task` can name."""
_REAL: Final = {"kuairand": "kuairand", "kuairec": "kuairec", "virtual-taobao": "virtualtaobao"}
"""Tasks that need files outside the package, and the subfolder of the data folder with them."""
_PACKAGES: Final = {"sardine-static": sardine.PACKAGE, "sardine-boredinf": sardine.PACKAGE}
"""Tasks that need an optional package, and its name."""
_SHARED: Final[Mapping[str, Method]] = {"ucf": METHODS["ucf"], **COMPONENTS, **PAPER}
_MEMORYLESS: Final = ("bc", "popular", "crm-greedy")
_CONTEXT: Final = 11
"""Context length K (steps): one more than the steps that exposure features look back."""


class RecommendationCells:
    """The cells of every table, for one request and budget and the data that is available."""

    def __init__(self, request: BenchmarkRequest, budget: Budget) -> None:
        self._request, self._budget = request, budget
        self._folder = request.out / budget.name
        self._plan = Plan(SUITE, self._folder, budget, partial(_settings, budget))
        self._tasks: dict[tuple[str, int], Task] = {}

    def cells(self, table: str) -> Iterator[Cell]:
        """The cells of a table."""
        made_by: dict[str, Callable[[Task], Iterator[Cell]]] = {
            "main": partial(self._list_trained, "main", METHODS),
            "shared": partial(self._list_trained, "shared", _SHARED),
            "sweeps": self._sweeps,
            "distractor": self._distractor,
        }
        names = [name for name in self._select_tasks(table) if _available(name)]
        if self._request.environment is not None:
            names = [self._request.environment.title]
        for name in names:
            for log in range(self._budget.logs):
                task = self._task(name, log)
                if table == "main" and log == 0:
                    yield from self._plan.list_built_in(table, task, METHODS)
                yield from made_by[table](task)

    def missing(self) -> list[str]:
        """Tasks of the main table that are excluded: their files or package are missing."""
        if self._request.environment is not None:
            return []
        return [name for name in self._select_tasks("main") if not _available(name)]

    def _select_tasks(self, table: str) -> Sequence[str]:
        if not self._request.tasks:
            return self._budget.tasks_in(table)
        available = _TASKS_OF.get(table, tuple(TASKS))
        return [name for name in self._request.tasks if name in available]

    def _sweeps(self, task: Task) -> Iterator[Cell]:
        """Cells of UCF with other λ, bands and gates; the main table has the defaults."""
        store = EpisodeStore.open(task.store)
        episodes, steps = store.all_steps()
        spread = float(store.step_values(schema.REWARD, episodes, steps).std())
        sweeps = {
            **{f"λ = {x:g}": f"policy.lambda_mask={x}" for x in LAMBDAS},
            **{f"band {low:g}–{top:g}": f"csg.band=[{low}, {top}]" for low, top in BANDS},
            **{f"ε_r = {x:g} σ": f"augment.epsilon_r={x * spread}" for x in GATES},
        }
        methods = {f"ucf, {name}": make_augmented_ucf(s) for name, s in sweeps.items()}
        yield from self._list_trained("sweeps", {**methods, **PAPER}, task)

    def _distractor(self, task: Task) -> Iterator[Cell]:
        """Cells of methods that are trained without and with a distractor in the logs.

        Those trained with it are evaluated with the distractor off and on. Every method is given
        the same target returns: choosing the target in validation episodes with the distractor off
        would use knowledge of the intervention.
        """
        environment = task.environments[DISTRACTED[task.name]]
        planted = task.store.with_name("distractor-store")
        if not planted.exists():
            plant_distractor(EpisodeStore.open(task.store), planted)
        name, folder = environment.name, environment.folder
        clean = replace(task, environments=(environment,))
        environments = tuple(DistractorEnvironment(name, folder, rate) for rate in (OFF, ON))
        title = f"{task.name}, distractor"
        both = (clean, replace(task, name=title, store=planted, environments=environments))
        # Cells that share a run lie far apart, so that no process waits for another's.
        for quantile, variant in product(DISTRACTOR_TARGETS, both):
            evaluation = replace(self._budget.evaluation, target_quantile=quantile)
            methods, conditions = DISTRACTOR_METHODS, {"quantiles": f"{quantile:g}"}
            yield from self._plan.list_trained(
                "distractor", variant, methods, evaluation, conditions
            )

    def _list_trained(
        self, table: str, methods: Mapping[str, Method], task: Task
    ) -> Iterator[Cell]:
        return self._plan.list_trained(table, task, methods, conditions={"quantiles": "rule"})

    def _task(self, name: str, log: int) -> Task:
        if (name, log) not in self._tasks:
            environment, seed = self._request.environment, self._request.log_seed
            log_request = Log(self._budget.sessions, seed + log, log, self._budget.logs)
            number: int | None = seed + log
            which = str(number)
            if name in tasks.LOGGED:
                number = log if self._budget.logs > 1 else None
                which = "whole" if number is None else f"{number}-of-{self._budget.logs}"
            folder = self._folder / "tasks" / f"{folder_name(name)}-{which}"
            make = TASKS[name] if environment is None else partial(tasks.simulated, environment)
            self._tasks[name, log] = replace(make(folder, log_request), name=name, log_seed=number)
        return self._tasks[name, log]


def _available(name: str) -> bool:
    return (name not in _REAL or data_folder(_REAL[name]).is_dir()) and (
        name not in _PACKAGES or find_spec(_PACKAGES[name]) is not None
    )


def _settings(budget: Budget, name: str, method: Method) -> tuple[str, ...]:
    """Settings of a training over the defaults; of methods with the paper's settings only the
    number of updates is the budget's."""
    if name in PAPER:
        return budget.shorten(method)
    memory = () if method.policy in _MEMORYLESS else (f"policy.context={_CONTEXT}",)
    settings = budget.of_policies.get(method.policy, ())
    return (*budget.settings, *memory, *settings, *method.settings)
