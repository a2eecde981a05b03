"""Which cells a table has, at a budget."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Final

from ucfrec import schema
from ucfrec.code_version import code_version, plugin_module
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation import gymnasium_environment
from ucfrec.evaluation.environment import GYMNASIUM, Environment
from ucfrec.policies.registry import policy_class
from ucfrec.provenance import config_hash
from ucfrec.runs.shared_stages import SharedStages
from ucfrec_simulators import sardine
from ucfrec_simulators.benchmark import cells, tasks
from ucfrec_simulators.benchmark.cells import Cell, EvaluationPlan
from ucfrec_simulators.benchmark.methods import ADDITIONS, METHODS, PAPER, SCREENED, Method
from ucfrec_simulators.benchmark.tasks import TASKS, BenchmarkTask, Log
from ucfrec_simulators.distractor import OFF, ON, DistractorEnvironment, plant_distractor
from ucfrec_simulators.folders import data_folder, folder_name


@dataclass(frozen=True)
class Budget:
    """The size of a benchmark; every budget measures all methods."""

    seeds: int
    """Training seeds of every cell."""
    logs: int
    """Logs of every task: simulated ones of as many seeds, or parts of a given log."""
    tasks: tuple[str, ...]
    """Tasks of the main table."""
    swept: tuple[str, ...]
    """Tasks of the sweeps; `--task` can name all of `SWEPT`."""
    distracted: tuple[str, ...]
    """Tasks of the distractor table; `--task` can name all of `DISTRACTED`."""
    sessions: int
    """Sessions collected where logs are simulated."""
    settings: tuple[str, ...]
    """Settings of all methods, over their defaults."""
    cuts: Mapping[str, tuple[str, ...]]
    """Further settings of single policies, by name (`ucfrec.policies.registry.policy_names`)."""
    evaluation: EvaluationPlan


SWEPT: Final = ("synthetic-catalog", "synthetic-taobao")
"""Tasks that can be swept. Not VirtualTaobao: there all sequence policies reach the maximum
return."""
DISTRACTED: Final = {"synthetic-taobao": 0, "synthetic-catalog": 0, "kuairand": 2}
"""Tasks that can have a distractor, and the index of the environment that is played. KuaiRand is
played as NX_10: all its sessions have the same length, so early exits do not hide the distractor's
effect."""
MAIN: Final = ("kuairand", "kuairec", "virtual-taobao", "synthetic-catalog", "sardine-boredinf")
BUDGETS: Final[Mapping[str, Budget]] = {
    # Sized for two cores: smaller width, fewer steps, smaller logs, fewer tasks beside those of the
    # main table, and cheaper settings of two baselines; methods and seeds are not reduced.
    "small": Budget(
        seeds=3,
        logs=2,
        tasks=MAIN,
        swept=("synthetic-catalog",),
        distracted=("synthetic-catalog",),
        sessions=6000,
        settings=(
            "policy.dim=64",
            "train.steps=400",
            "train.learning_rate=1e-3",
            "train.warmup_steps=40",
            "train.validate_every=100",
            "crm.epochs=8",
            "crm.learning_rate=4e-3",
            "rule.sessions=50",
        ),
        cuts={"dt4rec": ("policy.negatives=1",), "edt4rec": ("policy.cql_steps=400",)},
        evaluation=EvaluationPlan(episodes=300),
    ),
    "full": Budget(
        seeds=5,
        logs=3,
        tasks=(*MAIN, "sardine-static"),
        swept=SWEPT,
        distracted=tuple(DISTRACTED),
        sessions=50_000,
        settings=("train.steps=20000", "train.learning_rate=3e-4"),
        cuts={},
        evaluation=EvaluationPlan(episodes=5000),
    ),
}
_CONTEXT: Final = 11
"""Context length K (steps): one more than the steps that exposure features look back."""

LAMBDAS: Final = (0.0, 0.1, 0.5, 1.0)
BANDS: Final = ((0.05, 0.2), (1.0, 2.0))
GATES: Final = (0.02, 1e6)
"""ε_r in standard deviations of the rewards; the last value disables the gate. The first λ is the
default, and the line to compare with."""
DISTRACTOR_METHODS: Final[Mapping[str, Method]] = {
    **{name: METHODS[name] for name in ("bc", "dt", *PAPER, "ucf")},
    **SCREENED,
}
DISTRACTOR_TARGETS: Final = (1.0, 0.99)
"""Quantiles of the training returns: the default target, and one nearer to the logs."""
PURSUED: Final = ("kuairand", "synthetic-catalog", "sardine-boredinf")
"""Tasks of the table of additions, whose actions are items."""
_REAL: Final = {"kuairand": "kuairand", "kuairec": "kuairec", "virtual-taobao": "virtualtaobao"}
"""Tasks that need files outside the package, and the subfolder of the data folder with them."""
_PACKAGES: Final = {"sardine-static": sardine.PACKAGE, "sardine-boredinf": sardine.PACKAGE}
"""Tasks that need an optional package, and its name."""
_DISTRACTOR: Final = DistractorEnvironment.__module__
_GYMNASIUM_ENVIRONMENT: Final = gymnasium_environment.__name__
_ADDED: Final[Mapping[str, Method]] = {"ucf": METHODS["ucf"], **ADDITIONS, **PAPER}
_MEMORYLESS: Final = ("bc", "popular", "crm-greedy")


class Plan:
    """The cells of every table, for one budget and the data at hand."""

    def __init__(
        self,
        folder: Path,
        budget: Budget,
        name: str = "",
        log_seed: int = 0,
        environment: Environment | None = None,
        tasks: Sequence[str] = (),
    ) -> None:
        """Args:
        folder: where logs, stores, environments and runs are kept.
        budget: size of the benchmark.
        name: name of the budget, for the rows.
        log_seed: seed of the first simulated log of a task; the others have the seeds after it.
        environment: an environment whose cells the main table has instead; None for the budget's
            tasks.
        tasks: the only tasks of the tables; empty for all.
        """
        self._only = tasks
        self._folder, self._budget, self._name = folder, budget, name
        self._log_seed, self._environment = log_seed, environment
        self._tasks: dict[tuple[str, int], BenchmarkTask] = {}

    def main(self) -> Iterator[Cell]:
        """Cells of Table 2 with Table 3's ablations, and of the environments' built-in policies."""
        own = self._available(self._only or self._budget.tasks)
        for name in own if self._environment is None else [self._environment.title]:
            for log in range(self._budget.logs):
                task = self._task(name, log)
                for behavior in task.behaviors if log == 0 else ():
                    code = _code(task.environments)
                    yield Cell(
                        *("main", self._name, name, behavior, behavior, task.environments),
                        *(self._budget.evaluation, code, None),
                    )
                yield from self._all_trained("main", name, log, METHODS)

    def additions(self) -> Iterator[Cell]:
        """Cells of UCF with and without each addition to the paper; items only."""
        for name in self._available(PURSUED):
            for log in range(self._budget.logs):
                yield from self._all_trained("additions", name, log, _ADDED)

    def sweeps(self) -> Iterator[Cell]:
        """Cells of UCF with other λ, bands and gates; the main table has the defaults."""
        for name in self._available(SWEPT if self._only else self._budget.swept):
            for log in range(self._budget.logs):
                spread = _reward_spread(self._task(name, log).store)
                sweeps = {
                    **{f"λ = {x:g}": f"policy.lambda_mask={x}" for x in LAMBDAS},
                    **{f"band {low:g}–{top:g}": f"csg.band=[{low}, {top}]" for low, top in BANDS},
                    **{f"ε_r = {x:g} σ": f"augment.epsilon_r={x * spread}" for x in GATES},
                }
                methods = {f"ucf, {name}": Method("ucf", (s,)) for name, s in sweeps.items()}
                yield from self._all_trained("sweeps", name, log, {**methods, **PAPER})

    def distractor(self) -> Iterator[Cell]:
        """Cells of the distractor table: methods trained without and with a distractor in the logs.

        Those trained with it are evaluated with the distractor off and on. Every method is given
        the same target returns: choosing the target in validation episodes with the distractor off
        would use knowledge of the intervention.
        """
        plans = [replace(self._budget.evaluation, target_quantile=q) for q in DISTRACTOR_TARGETS]
        for name in self._available(DISTRACTED if self._only else self._budget.distracted):
            for log in range(self._budget.logs):
                clean = self._task(name, log)
                environment = clean.environments[DISTRACTED[name]]
                planted = clean.store.with_name("distractor-store")
                if not planted.exists():
                    plant_distractor(EpisodeStore.open(clean.store), planted)
                environments = tuple(
                    DistractorEnvironment(environment.name, environment.folder, r)
                    for r in (OFF, ON)
                )
                distracted = BenchmarkTask(planted, environments, ())
                both = {
                    name: replace(clean, environments=(environment,)),
                    f"{name}, distractor": distracted,
                }
                # Cells that share a run lie far apart, so that no process waits for another's.
                for seed, plan, label, title in product(
                    range(self._budget.seeds), plans, DISTRACTOR_METHODS, both
                ):
                    method = DISTRACTOR_METHODS[label]
                    yield from self._trained(
                        *("distractor", title, log, both[title], label, method, seed, plan)
                    )

    def missing(self) -> list[str]:
        """Tasks of the main table that are left out: their files or package are missing."""
        wanted = self._only or self._budget.tasks
        return [name for name in wanted if name not in self._available(wanted)]

    def _available(self, names: Iterable[str]) -> list[str]:
        return [
            name
            for name in names
            if (not self._only or name in self._only)
            and (name not in _REAL or data_folder(_REAL[name]).is_dir())
            and (name not in _PACKAGES or find_spec(_PACKAGES[name]) is not None)
        ]

    def _task(self, name: str, log: int) -> BenchmarkTask:
        if (name, log) not in self._tasks:
            environment = self._environment
            made_of = (name,) if environment is None else (environment.name,)
            # Another version of the code may write different logs, so each version has its folder.
            code = code_version(tasks.__name__, *map(_module, tasks.LOGGED.get(name, made_of)))
            number = self._number(name, log)
            which = "whole" if number is None else str(number)
            if name in tasks.LOGGED and number is not None:
                which = f"{which}-of-{self._budget.logs}"
            folder = self._folder / "tasks" / f"{folder_name(name)}-{which}-{code}"
            make = TASKS[name] if environment is None else partial(tasks.simulated, environment)
            given = Log(self._budget.sessions, self._log_seed + log, log, self._budget.logs)
            self._tasks[name, log] = make(folder, given)
        return self._tasks[name, log]

    def _number(self, name: str, log: int) -> int | None:
        """Seed of a simulated log, number of the part of a given one; None for all of it."""
        if name not in tasks.LOGGED:
            return self._log_seed + log
        return log if self._budget.logs > 1 else None

    def _all_trained(
        self, table: str, name: str, log: int, methods: Mapping[str, Method]
    ) -> Iterator[Cell]:
        for seed, label in product(range(self._budget.seeds), methods):
            task = self._task(name, log)
            yield from self._trained(table, name, log, task, label, methods[label], seed)

    def _trained(
        self,
        table: str,
        name: str,
        log: int,
        task: BenchmarkTask,
        label: str,
        method: Method,
        seed: int,
        evaluation: EvaluationPlan | None = None,
    ) -> Iterator[Cell]:
        """The cell of a trained method; none if the method does not support the task's actions.

        `evaluation` is the budget's unless given.
        """
        store = EpisodeStore.open(task.store)
        if not _supports(method, store):
            return
        task_name = name.partition(",")[0]
        memory = () if method.policy in _MEMORYLESS else (f"policy.context={_CONTEXT}",)
        cuts = self._budget.cuts.get(method.policy, ())
        settings = (*self._budget.settings, *memory, *cuts, *method.settings)
        code = _code(task.environments, policy_class(method.policy).__module__)
        # Where nothing but items was logged, there are no columns to screen.
        screening = method.screening if store.observation_size else None
        identity = {"policy": method.policy, "settings": settings, "code": code}
        identity |= {} if screening is None else {"screening": screening}
        run_hash = config_hash(identity | {"data": store.record.fingerprint})
        yield Cell(
            table=table,
            budget=self._name,
            task=name,
            method=label,
            policy=method.policy,
            environments=task.environments,
            evaluation=evaluation or self._budget.evaluation,
            code_version=code,
            log_seed=self._number(task_name, log),
            training_seed=seed,
            store=task.store,
            run=self._folder / "runs" / folder_name(name) / f"{method.policy}-{run_hash}-{seed}",
            shared=SharedStages(self._folder / "stages"),
            settings=settings,
            conditioned=method.conditioned,
            screening=screening,
        )


def _code(environments: Sequence[Environment], *learner: str) -> str:
    """The version of the code that a cell in `environments` depends on."""
    modules = [_module(environment.name) for environment in environments]
    distracted = any(isinstance(environment, DistractorEnvironment) for environment in environments)
    on_gymnasium = any(module in (_GYMNASIUM_ENVIRONMENT, sardine.__name__) for module in modules)
    apart = [] if distracted else [_DISTRACTOR]
    apart += [] if on_gymnasium else [_GYMNASIUM_ENVIRONMENT]
    return code_version(cells.__name__, *learner, *modules, exclude=apart)


def _module(environment: str) -> str:
    if environment.startswith(GYMNASIUM):
        return _GYMNASIUM_ENVIRONMENT
    return plugin_module("simulators", environment)


def _supports(method: Method, store: EpisodeStore) -> bool:
    if not store.has_items:
        return method.vectors
    return not method.tags or bool(store.item_states.tags.shape[1])


def _reward_spread(store: Path) -> float:
    """Standard deviation of the rewards of a store."""
    episodes = EpisodeStore.open(store)
    return float(episodes.step_values(schema.REWARD, *episodes.all_steps()).std())
