"""Which cells the control tables have, and the settings of each training."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.resources import files
from pathlib import Path

from ucfrec.benchmark.cells import PAPER_UCF, Budget, Cell, Method, Plan, Presets, Task
from ucfrec.benchmark.grid import select_names
from ucfrec.episodes.store import EpisodeStore
from ucfrec_control.benchmark.measure import DISTRACTOR, RATE
from ucfrec_control.benchmark.methods import METHODS, ROBUST, ROBUSTNESS, SCORES, TABLES
from ucfrec_control.data.distractor import DISTRACTORS, zoo_store
from ucfrec_control.training.rl_baselines import ALGORITHMS
from ucfrec_control.training.train import dataset_of, find_preset, preset_of


def score_cells(
    data: Path, folder: Path, budget: Budget, table: str, methods: Sequence[str] = ()
) -> Iterator[Cell]:
    """The cells of a table of scores; writes the stores that they need. InputError if a file is
    missing, or a method is not in the table.

    Args:
        data: folder of the HDF5 files.
        folder: gets runs, and stores in `stores`.
        budget: as `budget_of` returns it.
        table: a key of `TABLES`.
        methods: rows of the table; empty for all.
    """
    selected = _select(TABLES[table], methods or budget.methods)
    plan = _plan(SCORES, folder, budget)
    for file in budget.tasks:
        if file not in budget.optional or (data / f"{file}.hdf5").exists():
            store = zoo_store(data, folder / "stores", file)
            yield from plan.list_trained(table, Task(file, store), selected)


def set_contexts(budget: Budget, contexts: Mapping[str, int]) -> Budget:
    """`budget` with contexts of single methods."""
    settings = dict(budget.of_methods)
    for name, context in contexts.items():
        settings[name] = (*settings.get(name, ()), f"policy.context={context}")
    return replace(budget, of_methods=settings)


def robustness_cells(
    data: Path,
    folder: Path,
    budget: Budget,
    methods: Sequence[str] = (),
    distractors: Sequence[str] = (),
) -> Iterator[Cell]:
    """The cells of some methods of `ROBUST` and distractors (empty for all); arguments and errors
    as of `score_cells`."""
    selected = _select(ROBUST, methods)
    plan = _plan(ROBUSTNESS, folder, budget)
    for file in budget.tasks:
        for distractor in distractors or DISTRACTORS:
            store = zoo_store(data, folder / "stores", file, distractor)
            task = Task(file, store, conditions={DISTRACTOR: distractor})
            yield from plan.list_trained(ROBUSTNESS, task, selected)


def _plan(suite: str, folder: Path, budget: Budget) -> Plan:
    return Plan(suite, folder / budget.name, budget, partial(settings_of, budget), presets_of)


def presets_of(store: EpisodeStore, policy: str) -> Presets:
    """The presets of a policy for the dataset of a store; none of d3rlpy's algorithms."""
    return {} if policy in ALGORITHMS else preset_of(dataset_of(store), policy).tables


def _select(methods: Mapping[str, Method], names: Sequence[str]) -> dict[str, Method]:
    return {name: methods[name] for name in select_names(methods, names, "method")}


@cache
def chosen_rates(budget: str) -> Mapping[str, float]:
    """Learning rates of some methods, one of each policy, chosen on validation loss; empty for a
    budget without a search."""
    text = files("ucfrec_control.benchmark").joinpath("rates.toml").read_text(encoding="utf-8")
    rates: Mapping[str, float] = tomllib.loads(text).get(budget, {})
    return rates


def settings_of(budget: Budget, name: str, method: Method) -> tuple[str, ...]:
    """Settings of a training over its presets: the budget's, the chosen rate, the method's own; of
    methods with the paper's settings only the number of updates is the budget's."""
    longer = budget.of_methods.get(name, ())
    if name.startswith(PAPER_UCF):
        return (*budget.shorten(method, find_preset("", "", method.policy).tables), *longer)
    policy_settings = budget.of_policies.get(method.policy, ())
    rate = _rate_of(budget, method)
    if method.policy in ALGORITHMS:
        return (*policy_settings, *(() if rate is None else (f"{RATE}={rate:g}",)))
    searched = () if rate is None else (f"train.{RATE}={rate:g}",)
    return (*budget.settings, *policy_settings, *searched, *method.settings, *longer)


def _rate_of(budget: Budget, method: Method) -> float | None:
    """The rate chosen for a method of the same policy; None if there is none."""
    rates = chosen_rates(budget.name).items()
    return next((rate for name, rate in rates if METHODS[name].policy == method.policy), None)
