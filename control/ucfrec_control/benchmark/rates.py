"""Learning rates of the benchmark's methods, chosen on validation loss by one small search."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, read_toml
from ucfrec.provenance import provenance
from ucfrec.reporting.grid import Measurement, chosen
from ucfrec.reporting.result_row import ResultRow, RowKey
from ucfrec.reporting.statistics import grouped
from ucfrec_control.benchmark.budgets import RATES, Budget
from ucfrec_control.benchmark.cells import Cell, code_of, config, key
from ucfrec_control.benchmark.folders import stores_of
from ucfrec_control.benchmark.methods import METHODS, METHODS_WO_TIME, Methods
from ucfrec_control.benchmark.run_cells import run_cells
from ucfrec_control.data.distractor import zoo_store
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.learners.rl_baselines import ALGORITHMS, action_loss, train_rl
from ucfrec_control.learners.train import train_control

SUITE: Final = "rates"
"""Suite of the rows."""
RATE: Final = "learning_rate"
"""Condition of the rows."""
_TIME, _COPIES = "policy.max_timestep", "augment.copies"


def _differing(methods: Methods) -> Methods:
    """The methods of the main table that differ in learner or embeddings of time."""
    found: dict[tuple[str, tuple[str, ...]], str] = {}
    for name, (learner, settings) in methods.items():
        found.setdefault((learner, _of_time(settings)), name)
    return {name: (learner, settings) for (learner, settings), name in found.items()}


def _one_each(methods: Methods) -> Methods:
    """One method of each learner: where there are two, that without embeddings of time."""
    without_time = set(METHODS_WO_TIME.values())
    return {
        name: (learner, settings)
        for name, (learner, settings) in methods.items()
        if learner not in METHODS_WO_TIME or name in without_time
    }


def _of_time(settings: Sequence[str]) -> tuple[str, ...]:
    return tuple(each for each in settings if each.startswith(_TIME))


_DIFFERING: Final = _differing(METHODS)
"""Learner and settings of the methods that can have a rate of their own, by name."""
SEARCHED: Final = _one_each(_DIFFERING)
"""Those of them that are tried; the others take the rate that was chosen for their learner."""


@cache
def chosen_rates(budget: str) -> Mapping[str, float]:
    """The chosen rate of each method of `SEARCHED`; empty for a budget without a search.

    Args:
        budget: a name of a budget.
    """
    text = files("ucfrec_control.benchmark").joinpath("rates.toml").read_text(encoding="utf-8")
    rates: Mapping[str, float] = tomllib.loads(text).get(budget, {})
    return rates


def read_rates(path: Path) -> dict[str, dict[str, float]]:
    """Rates by budget and method, of a file that `write_rates` wrote.

    Raises:
        InputError: the file is missing, or not of such tables.
    """
    tables: dict[str, dict[str, float]] = read_toml(path)
    if unknown := [budget for budget in tables if budget not in RATES]:
        raise InputError(
            f"{path}: no budget is called {unknown[0]:.60}; there are {', '.join(RATES)}"
        )
    for budget, rates in tables.items():
        _require_rates(path, rates if isinstance(rates, Mapping) else {budget: rates})
    return tables


def _require_rates(path: Path, rates: Mapping[str, object]) -> None:
    for method, rate in rates.items():
        if method not in _DIFFERING or not isinstance(rate, float | int) or not 0 < rate < 1:
            raise InputError(
                f"{path}: {method!r:.60} = {rate!r:.60} is no learning rate of a method; there "
                f"are {', '.join(_DIFFERING)}"
            )


def write_rates(path: Path, budget: str, rates: Mapping[str, float]) -> None:
    """Write rates to a file; its rates of other budgets and methods stay.

    Raises:
        InputError: the file exists and is not of such tables, or a rate is of no method.
    """
    _require_rates(path, rates)
    tables = read_rates(path) if path.exists() else {}
    tables[budget] = {**tables.get(budget, {}), **rates}
    with atomic_file(path) as scratch:
        scratch.write_text("\n".join(map(format_rates, tables.items())), encoding="utf-8")


def format_rates(table: tuple[str, Mapping[str, float]]) -> str:
    """A budget and its rates as a table of TOML."""
    budget, rates = table
    return "".join(
        f"{line}\n" for line in (f"[{budget}]", *(f"{m} = {rate:g}" for m, rate in rates.items()))
    )


def settings_of(
    budget: Budget, name: str, learner: str, settings: Sequence[str]
) -> tuple[str, ...]:
    """Settings of a training over its presets: the budget's, the chosen rate, the method's own;
    none of IQL and CQL (`rl_settings_of`).

    Args:
        budget: size of the benchmark.
        name: its name.
        learner: as `Cell.learner`.
        settings: of the method.
    """
    if learner in ALGORITHMS:
        return ()
    time = _of_time(settings)
    if learner == "ucf" and time == _of_time(METHODS["dt-wo-time"][1]):
        time = ()  # the preset
    rates = _rates_of(budget, name)
    own = [name for name, kind in _DIFFERING.items() if kind == (learner, time)]
    of_learner = [name for name, (each, _) in SEARCHED.items() if each == learner]
    rate = next((rates[name] for name in (*own, *of_learner) if name in rates), None)
    searched = () if rate is None else (f"train.{RATE}={rate:g}",)
    return (*budget.settings_of(learner), *searched, *settings)


def rl_settings_of(budget: Budget, name: str, learner: str) -> dict[str, Any]:
    """Settings of a training of IQL or CQL: the budget's and the chosen rate; none of others.

    Args:
        budget, name, learner: as of `settings_of`.
    """
    if learner not in ALGORITHMS:
        return {}
    rate = _rates_of(budget, name).get(learner)
    return {**budget.rl[learner], **({} if rate is None else {RATE: rate})}


def _rates_of(budget: Budget, name: str) -> Mapping[str, float]:
    return chosen_rates(name) if budget.rates is None else budget.rates


def search_rates(
    data: Path,
    folder: Path,
    results: Path,
    budget: Budget,
    name: str,
    workers: int,
    methods: Sequence[str] = (),
    steps: int | None = None,
) -> list[ResultRow]:
    """Train every method at every rate, without copies; returns a row with the validation loss of
    each training.

    Args:
        data: folder of the HDF5 files.
        folder: where stores and runs are kept.
        results: file of JSON lines; what has its row is not repeated.
        budget: size of the trainings.
        name: name of the budget.
        workers: number of processes, of one thread each.
        methods: some of `SEARCHED`; empty for all.
        steps: updates of a training; None for the budget's.

    Raises:
        InputError: a file is missing or has no validation trajectories, a method is unknown,
            `results` has other content, or cells failed.
    """
    selected = chosen(SEARCHED, methods, "method")
    cells = _cells(data, folder, budget, name, selected, steps)
    return run_cells(cells, _MEASUREMENT, results, workers, SUITE)


def _cells(
    data: Path, folder: Path, budget: Budget, name: str, methods: Sequence[str], steps: int | None
) -> Iterator[Cell]:
    shorter = () if steps is None else (f"train.steps={steps}", f"train.validate_every={steps}")
    rl_shorter = {} if steps is None else {"steps": steps}
    # Shorter trainings are runs of their own.
    part = "" if steps is None else f"{steps}-"
    for file in budget.files_in(data):
        store = zoo_store(data, stores_of(folder), file)
        if not EpisodeStore.open(store).split("validation").n_episodes:
            raise InputError(
                f"{file} has too few trajectories for validation, by which rates are chosen; name "
                "a larger file with --file"
            )
        for method in methods:
            learner, own = SEARCHED[method]
            code = code_of(learner)
            rl = learner in ALGORITHMS
            for rate in RATES[name]:
                searched = (f"{_COPIES}=0", *shorter, f"train.{RATE}={rate:g}", *own)
                for seed in range(budget.seeds_of(file, method)):
                    yield Cell(
                        suite=SUITE,
                        table=f"{rate:g}",
                        budget=name,
                        file=file,
                        method=method,
                        learner=learner,
                        settings=() if rl else (*budget.settings_of(learner), *searched),
                        store=store,
                        run=folder / SUITE / name / file / f"{method}-{rate:g}-{part}{code}-{seed}",
                        seed=seed,
                        episodes=0,
                        evaluation_seed=budget.evaluation_seed,
                        code_version=code,
                        rl={**budget.rl[learner], **rl_shorter, RATE: rate} if rl else {},
                    )


def _measure(cell: Cell, row_key: RowKey) -> list[ResultRow]:
    store = EpisodeStore.open(cell.store)
    if cell.learner in ALGORITHMS:
        rl = train_rl(store, cell.run, cell.rl_config, cell.seed)
        rate, loss = cell.rl[RATE], action_loss(cell.run, store)
        steps, seconds = rl.finished.steps, rl.wall_time_s
    else:
        record = train_control(store, cell.run, cell.config)
        loss, rate = record.finished.best_validation, cell.config.train.learning_rate
        steps, seconds = record.finished.steps, record.wall_time_s
    row = ResultRow(
        **vars(row_key) | {"conditions": {**row_key.conditions, RATE: rate}},
        metric="validation_loss",
        metrics={"validation_loss": loss, "steps": float(steps)},
        wall_time_s=seconds,
        **provenance(PACKAGES),
    )
    return [row]


_MEASUREMENT: Final = Measurement(key, config, _measure)


def best_rates(rows: Sequence[ResultRow]) -> dict[str, float]:
    """The rate of each method with the lowest loss, in the mean over files and seeds, each relative
    to the lowest loss of the method there.

    Args:
        rows: of one budget, as returned by `search_rates`.
    """
    found = {}
    for method, own in grouped(rows, lambda row: row.method).items():
        relative: dict[Any, list[float]] = {}
        for group in grouped(own, lambda row: (row.task, row.training_seed)).values():
            lowest = min(row.value for row in group)
            for row in group:
                relative.setdefault(row.conditions[RATE], []).append(row.value / lowest)
        found[method] = min(relative, key=lambda rate: float(np.mean(relative[rate])))
    return found
