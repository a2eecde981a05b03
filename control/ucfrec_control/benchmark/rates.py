"""Learning rates of the benchmark's methods, chosen on validation loss by one small search."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from ucfrec.benchmark.cells import Budget, Method
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_file, read_toml
from ucfrec.results.row import ResultRow
from ucfrec.results.statistics import grouped
from ucfrec_control.benchmark.budgets import TRIED_RATES
from ucfrec_control.benchmark.measure import RATE
from ucfrec_control.benchmark.methods import METHODS, METHODS_WO_TIME, Methods
from ucfrec_control.training.rl_baselines import ALGORITHMS

_TIME: Final = "policy.max_timestep"


def _differing(methods: Methods) -> Methods:
    """The methods of the main table that differ in policy or embeddings of time."""
    found: dict[tuple[str, tuple[str, ...]], str] = {}
    for name, method in methods.items():
        found.setdefault((method.policy, _of_time(method.settings)), name)
    return {name: methods[name] for name in found.values()}


def _one_each(methods: Methods) -> Methods:
    """One method of each policy: where there are two, that without embeddings of time."""
    without_time = set(METHODS_WO_TIME.values())
    return {
        name: method
        for name, method in methods.items()
        if method.policy not in METHODS_WO_TIME or name in without_time
    }


def _of_time(settings: Sequence[str]) -> tuple[str, ...]:
    return tuple(each for each in settings if each.startswith(_TIME))


_DIFFERING: Final = _differing(METHODS)
"""The methods that can have a rate of their own, by name."""
SEARCHED: Final = _one_each(_DIFFERING)
"""Those of them that are tried; the others take the rate that was chosen for their policy."""


@cache
def chosen_rates(budget: str) -> Mapping[str, float]:
    """The chosen rate of each method of `SEARCHED`; empty for a budget without a search."""
    text = files("ucfrec_control.benchmark").joinpath("rates.toml").read_text(encoding="utf-8")
    rates: Mapping[str, float] = tomllib.loads(text).get(budget, {})
    return rates


def read_rates(path: Path) -> dict[str, dict[str, float]]:
    """Rates by budget and method, of a file that `write_rates` wrote.

    Raises:
        InputError: the file is missing, or not of such tables.
    """
    tables: dict[str, dict[str, float]] = read_toml(path)
    if unknown := [budget for budget in tables if budget not in TRIED_RATES]:
        raise InputError(
            f"{path}: no budget is called {unknown[0]:.60}; there are {', '.join(TRIED_RATES)}"
        )
    for budget, rates in tables.items():
        _require_rates(path, rates if isinstance(rates, Mapping) else {budget: rates})
    return tables


def _require_rates(path: Path, rates: Mapping[str, object]) -> None:
    for method, rate in rates.items():
        if method not in _DIFFERING or not isinstance(rate, float | int) or not 0 < rate < 1:
            raise InputError(
                f"{path}: {method!r:.60} = {rate!r:.60} is not a learning rate of a method; there "
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


def settings_of(budget: Budget, name: str, method: Method) -> tuple[str, ...]:
    """Settings of a training over its presets: the budget's, the chosen rate, the method's own."""
    own = budget.of_policies.get(method.policy, ())
    rate = _rate_of(budget, method)
    if method.policy in ALGORITHMS:
        return (*own, *(() if rate is None else (f"{RATE}={rate:g}",)))
    searched = () if rate is None else (f"train.{RATE}={rate:g}",)
    longer = budget.of_methods.get(name, ())
    return (*budget.settings, *own, *searched, *method.settings, *longer)


def _rate_of(budget: Budget, method: Method) -> float | None:
    """The chosen rate of a method, or of another one of its policy; None if there is none."""
    time = _of_time(method.settings)
    if method.policy == "ucf" and time == _of_time(METHODS["dt-wo-time"].settings):
        time = ()  # the preset
    rates = chosen_rates(budget.name) if budget.rates is None else budget.rates
    own = [
        name
        for name, each in _DIFFERING.items()
        if (each.policy, _of_time(each.settings)) == (method.policy, time)
    ]
    of_policy = [name for name, each in SEARCHED.items() if each.policy == method.policy]
    return next((rates[name] for name in (*own, *of_policy) if name in rates), None)


def best_rates(rows: Sequence[ResultRow]) -> dict[str, float]:
    """The rate of each method with the lowest loss, in the mean over files and seeds, each relative
    to the lowest loss of the method there.

    Args:
        rows: of one budget, of suite `rates`.
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
