"""Plugins: simulators, datasets, benchmarks and learners that packages declare as entry points.

A package adds a simulator to the command line by declaring, in the entry-point group
`ucfrec.simulators`, a short name that points to a `Simulator`. Datasets are declared in
`ucfrec.datasets`, benchmarks (`Benchmark`) in `ucfrec.benchmarks`, and learners (classes derived
from `ucfrec.policies.base.SequencePolicy`) in `ucfrec.policies`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ucfrec.errors import InputError

if TYPE_CHECKING:
    from ucfrec.evaluation.environment import Environment
    from ucfrec.reporting.result_row import ResultRow

_ONE_OF: Final = {
    "benchmarks": "benchmark",
    "datasets": "dataset",
    "policies": "policy",
    "simulators": "simulator",
}
"""Singular of each group, for messages."""


@dataclass(frozen=True)
class Benchmark:
    """A set of tables that `ucfrec benchmark NAME` measures and prints."""

    summary: str
    """One line for `--help`."""
    tables: tuple[str, ...]
    """Names of the tables, in the order in which they are measured."""
    run: Callable[["BenchmarkRequest"], str]
    """Measures the cells that have no result row yet; returns the tables as Markdown."""
    show: Callable[[Sequence[str], Sequence["ResultRow"]], str]
    """Formats (table names, result rows) as Markdown; tables without any result are left out."""


@dataclass(frozen=True)
class BenchmarkRequest:
    """Which tables of a benchmark are measured, and where the results are written."""

    budget: str
    """Name of the budget: how many seeds, training steps and episodes are spent on a cell."""
    tables: Sequence[str]
    """Names of the tables to measure."""
    out: Path
    """Folder for logs, stores and runs."""
    results: Path
    """File to which result rows are added."""
    workers: int
    """Number of parallel processes."""
    log_seed: int = 0
    """Seed of the first simulated log of a task; the others have the seeds after it."""
    logs: int | None = None
    """Number of logs of each task; None for the budget's."""
    evaluation_seed: int | None = None
    """Seed of the evaluation episodes; None stands for the budget's."""
    environment: "Environment | None" = None
    """An environment that is measured instead of the suite's tasks; None for these."""
    tasks: Sequence[str] = ()
    """Names of the only tasks to measure; empty for all."""
    methods: Sequence[str] = ()
    """Names of the only methods to measure; empty for all."""
    again: bool = False
    """Whether cells that have rows are measured again."""
    training_seeds: int | None = None
    """Number of training seeds of each cell; None for the budget's."""


def plugin_names(group: str) -> list[str]:
    """Names of the plugins installed in the entry-point group `ucfrec.<group>`, sorted."""
    return sorted(entry_points(group=f"ucfrec.{group}").names)


def load_plugin(group: str, name: str) -> Any:
    """Import the plugin `name` of the entry-point group `ucfrec.<group>`.

    Raises:
        InputError: no plugin of that name is installed, or it cannot be imported.
    """
    installed = entry_points(group=f"ucfrec.{group}")
    if name not in installed.names:
        known = ", ".join(plugin_names(group)) or "none"
        raise InputError(f"no {_ONE_OF[group]} is called {name!r}; installed: {known}")
    entry = installed[name]
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the {_ONE_OF[group]} {name!r} is installed as {entry.value}, which cannot be "
            f"imported ({error}); reinstall its package"
        ) from error
