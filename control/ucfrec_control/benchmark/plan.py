"""Which cells the control tables have: scores, learning rates and robustness to distractors."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from ucfrec.benchmark.cells import Budget, Cell, Method, Task
from ucfrec.benchmark.grid import chosen
from ucfrec.benchmark.plan import Plan, Presets
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec_control.benchmark.budgets import TRIED_CONTEXTS, TRIED_RATES
from ucfrec_control.benchmark.measure import CONTEXT, DISTRACTOR, RATE
from ucfrec_control.benchmark.methods import (
    CONTEXTS,
    MAIN,
    RATES,
    ROBUST,
    ROBUSTNESS,
    SCORES,
    SPREAD,
    TABLES,
)
from ucfrec_control.benchmark.rates import SEARCHED, settings_of
from ucfrec_control.benchmark.spread import BACK
from ucfrec_control.data.distractor import DISTRACTORS, zoo_store
from ucfrec_control.training.kept import KEPT, kept_steps
from ucfrec_control.training.rl_baselines import ALGORITHMS
from ucfrec_control.training.train import dataset_of, preset_of


def stores_of(folder: Path) -> Path:
    """The folder of the stores."""
    return folder / "stores"


def score_cells(
    data: Path, folder: Path, budget: Budget, table: str, methods: Sequence[str] = ()
) -> Iterator[Cell]:
    """The cells of a table of scores; writes the stores that they need.

    Args:
        data: folder of the HDF5 files.
        budget: as `budget_of` returns it.
        table: a key of `TABLES`.
        methods: rows of the table; empty for all.

    Raises:
        InputError: a file is missing, or a method is not in the table.
    """
    selected = _selected(TABLES[table], methods or budget.methods)
    plan = _plan(SCORES, folder, budget)
    for file in budget.tasks:
        if file not in budget.optional or (data / f"{file}.hdf5").exists():
            store = zoo_store(data, stores_of(folder), file)
            yield from plan.trained(table, Task(file, store), selected)


def context_cells(
    data: Path, folder: Path, budget: Budget, methods: Sequence[str] = ()
) -> Iterator[Cell]:
    """The cells of methods of the main table with each of `TRIED_CONTEXTS`; arguments and errors as
    of `score_cells`, which shares the runs of the context that it is given."""
    names = methods or budget.methods
    for context in TRIED_CONTEXTS:
        given = with_contexts(budget, dict.fromkeys(names, context))
        for cell in score_cells(data, folder, given, MAIN, names):
            yield replace(cell, suite=CONTEXTS, table=CONTEXTS, conditions={CONTEXT: context})


def with_contexts(budget: Budget, contexts: Mapping[str, int]) -> Budget:
    """`budget` with contexts of single methods."""
    settings = dict(budget.of_methods)
    for name, context in contexts.items():
        settings[name] = (*settings.get(name, ()), f"policy.context={context}")
    return replace(budget, of_methods=settings)


def spread_cells(
    data: Path, folder: Path, budget: Budget, methods: Sequence[str] = (), checkpoints: int = KEPT
) -> Iterator[Cell]:
    """A cell for each of the last checkpoints of the trainings of the main table.

    Args:
        data, folder, budget, methods: as of `score_cells`, whose runs they share.
        checkpoints: number of last checkpoints, at most `KEPT`.

    Raises:
        InputError: as `score_cells`, or a method is trained without averaging.
    """
    for cell in score_cells(data, folder, budget, MAIN, methods):
        if cell.policy in ALGORITHMS or not cell.config.train.average:
            raise InputError(
                f"{cell.method} of budget {budget.name} is trained without train.average, so it "
                "has no averaged weights; name another --method, or --budget medium"
            )
        for back in range(min(checkpoints, len(kept_steps(cell.config.train)))):
            yield replace(cell, suite=SPREAD, table=SPREAD, conditions={BACK: back})


def robustness_cells(
    data: Path,
    folder: Path,
    budget: Budget,
    methods: Sequence[str] = (),
    distractors: Sequence[str] = (),
) -> Iterator[Cell]:
    """The cells of some methods of `ROBUST` and distractors (empty for all); arguments and errors
    as of `score_cells`."""
    selected = _selected(ROBUST, methods)
    plan = _plan(ROBUSTNESS, folder, budget)
    for file in budget.tasks:
        for distractor in distractors or DISTRACTORS:
            store = zoo_store(data, stores_of(folder), file, distractor)
            task = Task(file, store, conditions={DISTRACTOR: distractor})
            yield from plan.trained(ROBUSTNESS, task, selected)


def rate_cells(
    data: Path,
    folder: Path,
    budget: Budget,
    methods: Sequence[str] = (),
    steps: int | None = None,
) -> Iterator[Cell]:
    """The cells of every method at every rate, without augmentation and evaluation.

    Args:
        data, folder, budget: as of `score_cells`.
        methods: some of `SEARCHED`; empty for all.
        steps: updates of a training; None for the budget's.

    Raises:
        InputError: a file is missing or has no validation trajectories, or a method is unknown.
    """
    selected = _selected(SEARCHED, methods)
    budget = replace(budget, evaluation=replace(budget.evaluation, episodes=0))
    for file in budget.tasks:
        store = zoo_store(data, stores_of(folder), file)
        if not EpisodeStore.open(store).split("validation").n_episodes:
            raise InputError(
                f"{file} has too few trajectories for validation, by which rates are chosen; name "
                "a larger file with --file"
            )
        for rate in TRIED_RATES[budget.name]:
            plan = replace(
                _plan(RATES, folder, budget), settings=partial(_at_rate, budget, rate, steps)
            )
            task = Task(file, store, conditions={RATE: rate})
            yield from plan.trained(f"{rate:g}", task, selected)


def _plan(suite: str, folder: Path, budget: Budget) -> Plan:
    return Plan(suite, folder / budget.name, budget, partial(settings_of, budget), _presets)


def _presets(store: EpisodeStore, policy: str) -> Presets:
    return {} if policy in ALGORITHMS else preset_of(dataset_of(store), policy).tables


def _at_rate(
    budget: Budget, rate: float, steps: int | None, name: str, method: Method
) -> tuple[str, ...]:
    """Settings of a training without augmentation at a rate."""
    own = budget.of_policies.get(method.policy, ())
    if method.policy in ALGORITHMS:
        return (*own, *([] if steps is None else [f"steps={steps}"]), f"{RATE}={rate:g}")
    shorter = [] if steps is None else [f"train.steps={steps}", f"train.validate_every={steps}"]
    searched = ("augment.copies=0", *shorter, f"train.{RATE}={rate:g}")
    return (*budget.settings, *own, *method.settings, *searched)


def _selected(methods: Mapping[str, Method], names: Sequence[str]) -> dict[str, Method]:
    return {name: methods[name] for name in chosen(methods, names, "method")}
