"""What sibling packages, and anyone's own, announce through entry points.

A package adds a simulator to the command line by declaring, under the entry-point group
`ucfrec.simulators`, a short name that points at a `Simulator`; datasets likewise under
`ucfrec.datasets`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv

from ucfrec.errors import InputError
from ucfrec.rollout import Actor


@dataclass(frozen=True)
class Simulator:
    """A world that sessions are played in."""

    summary: str
    """One line for `--help`."""
    make: Callable[[int, Path | None], VectorEnv[Any, Any, Any]]
    """(number of sessions side by side, folder of weights or None) to a vector environment with
    `AutoresetMode.SAME_STEP`."""
    behaviors: Mapping[str, Callable[[VectorEnv[Any, Any, Any], int], Actor]]
    """Built-in policies by name, each made from (environment, seed): `random`, `mixture`, and
    `optimal` where it is known."""
    feedback: str
    """Column that holds the reward in the logs that `ucfrec collect` writes."""


def load_plugin(group: str, name: str) -> Any:
    """Load the object that `name` stands for in the entry-point group `ucfrec.<group>`.

    Raises:
        InputError: nothing of that name is installed.
    """
    found = entry_points(group=f"ucfrec.{group}")
    if name not in found.names:
        known = ", ".join(sorted(found.names)) or "none"
        raise InputError(f"no {group[:-1]} is called {name!r}; installed: {known}")
    return found[name].load()
