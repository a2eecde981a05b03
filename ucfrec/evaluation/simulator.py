"""Simulators: plugins of the entry-point group `ucfrec.simulators`, and environments by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from ucfrec.arrays import IntArray
from ucfrec.errors import InputError
from ucfrec.plugins import load_plugin
from ucfrec.schema import ITEM_ID

if TYPE_CHECKING:
    import pyarrow as pa
    from gymnasium.vector import VectorEnv

    from ucfrec.acting.rollout import Actor

COLUMNS = ("coverage", "coverage_per_turn", "diversity", "novelty")
"""Metrics of the items that were recommended, where they can be measured."""


@dataclass(frozen=True)
class Simulator:
    """A simulated environment."""

    summary: str
    """One line for `--help`."""
    make: "Callable[[int, Path | None], VectorEnv[Any, Any, Any]]"
    """Makes a vector environment with `AutoresetMode.SAME_STEP` from (number of parallel sessions,
    folder of weights or None)."""
    behaviors: "Mapping[str, Callable[[VectorEnv[Any, Any, Any], int], Actor]]"
    """Built-in behavior policies by name, each made from (environment, seed): `random`, mostly
    `mixture`, which is logged by default, and `optimal` if it is known."""
    feedback: str
    """Name of the reward column in the logs that `ucfrec collect` writes."""

    @property
    def logging_behavior(self) -> str:
        """The behavior policy of logs unless another is named."""
        return "mixture" if "mixture" in self.behaviors else "random"


GYMNASIUM = "gymnasium:"
"""Start of the names of environments that are Gymnasium environments."""


@runtime_checkable
class Catalog(Protocol):
    """A simulated environment with a table of its items."""

    def item_features(self) -> "pa.Table":
        """One row per item in the order of the action indices, with a column `item_id`."""


def environment_items(env: "VectorEnv[Any, Any, Any]") -> IntArray:
    """Identifiers (n_items,) of an environment's items in logs: of its catalogue, or indices."""
    environment = env.unwrapped
    if isinstance(environment, Catalog):
        return np.asarray(environment.item_features()[ITEM_ID], dtype=np.int64)
    space: Any = env.single_action_space
    return np.arange(int(space.n))


@dataclass(frozen=True)
class Environment:
    """A simulator and its source."""

    name: str
    """Name of a simulator plugin, or `gymnasium:` and the identifier of an environment."""
    folder: Path | None = None
    """Folder of the simulator's weights; None if it needs none."""

    observe: tuple[str, ...] = field(default=(), kw_only=True)
    """Entries of a Gymnasium environment's dict observation that are observed."""
    item_features: str | None = field(default=None, kw_only=True)
    """File or attribute of a Gymnasium environment with features of its items; None for none."""

    @property
    def title(self) -> str:
        """The name, and the options that belong to it as the command line has them."""
        observe = f" --observe {','.join(self.observe)}" if self.observe else ""
        features = f" --item-features {self.item_features}" if self.item_features else ""
        return self.name + observe + features

    def start(
        self,
        sessions: int,
        behavior: str,
        seed: int,
    ) -> "tuple[VectorEnv[Any, Any, Any], Actor]":
        """Parallel sessions and a built-in policy for them; InputError if none has that name."""
        simulator = self.simulator()
        if behavior not in simulator.behaviors:
            names = ", ".join(simulator.behaviors)
            raise InputError(f"{self.name} has no behavior {behavior!r}; it has {names}")
        env = simulator.make(sessions, self.folder)
        return env, simulator.behaviors[behavior](env, seed)

    def simulator(self) -> Simulator:
        """Load the simulator plugin, or make the one of a Gymnasium environment; InputError if it
        is not installed, or takes no `observe` and `item_features`."""
        if self.name.startswith(GYMNASIUM):
            from ucfrec.acting.rollout import Uniform
            from ucfrec.evaluation import gymnasium_environment as wrapped

            env_id = self.name.removeprefix(GYMNASIUM)

            def make(num_envs: int, _: Path | None) -> wrapped.GymnasiumEnvironment:
                if self.item_features is None:
                    return wrapped.GymnasiumEnvironment(env_id, num_envs, self.observe)
                items = partial(wrapped.item_table, self.item_features)
                return wrapped.GymnasiumCatalog(env_id, num_envs, items, self.observe)

            summary = f"the Gymnasium environment {env_id}"
            return Simulator(summary, make, behaviors={"random": Uniform}, feedback=wrapped.REWARD)
        if self.observe or self.item_features is not None:
            raise InputError(
                f"--observe and --item-features are for {GYMNASIUM}ID; leave them out for "
                f"{self.name}"
            )
        simulator: Simulator = load_plugin("simulators", self.name)
        return simulator
