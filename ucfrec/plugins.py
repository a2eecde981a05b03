"""What sibling packages, and anyone's own, announce through entry points.

A package adds a simulator to the command line by declaring, under the entry-point group
`ucfrec.simulators`, a short name that points at a `Simulator`; datasets likewise under
`ucfrec.datasets`, benchmarks under `ucfrec.benchmarks`, and learners, as classes derived from
`ucfrec.policies.base.SequencePolicy`, under `ucfrec.policies`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ucfrec.errors import InputError

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from ucfrec.acting.rollout import Actor

_ONE_OF: Final = {
    "benchmarks": "benchmark",
    "datasets": "dataset",
    "policies": "policy",
    "simulators": "simulator",
}
"""What one plugin of a group is called."""


@dataclass(frozen=True)
class Simulator:
    """A world that sessions are played in."""

    summary: str
    """One line for `--help`."""
    make: "Callable[[int, Path | None], VectorEnv[Any, Any, Any]]"
    """(number of sessions side by side, folder of weights or None) to a vector environment with
    `AutoresetMode.SAME_STEP`."""
    behaviors: "Mapping[str, Callable[[VectorEnv[Any, Any, Any], int], Actor]]"
    """Built-in policies by name, each made from (environment, seed): `random`, `mixture`, and
    `optimal` where it is known."""
    feedback: str
    """Column that holds the reward in the logs that `ucfrec collect` writes."""


@dataclass(frozen=True)
class Benchmark:
    """Tables that `ucfrec benchmark NAME` measures and prints."""

    summary: str
    """One line for `--help`."""
    tables: tuple[str, ...]
    """By name, in the order in which they are measured."""
    run: Callable[[str, Sequence[str], Path, Path, int], str]
    """(budget, tables, folder of runs, file of result rows, processes) to the tables as Markdown;
    cells that have rows already are not measured again."""


def plugin_names(group: str) -> list[str]:
    """Everything installed under the entry-point group `ucfrec.<group>`, sorted."""
    return sorted(entry_points(group=f"ucfrec.{group}").names)


def load_plugin(group: str, name: str) -> Any:
    """Load the object that `name` stands for in the entry-point group `ucfrec.<group>`.

    Raises:
        InputError: nothing of that name is installed, or it cannot be imported.
    """
    found = entry_points(group=f"ucfrec.{group}")
    if name not in found.names:
        known = ", ".join(plugin_names(group)) or "none"
        raise InputError(f"no {_ONE_OF[group]} is called {name!r}; installed: {known}")
    entry = found[name]
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the {_ONE_OF[group]} {name!r} is installed as {entry.value}, which cannot be "
            f"imported: {error}"
        ) from error
