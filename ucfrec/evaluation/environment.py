"""Simulated environments by name."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Simulator
from ucfrec.plugins import load_plugin

GYMNASIUM: Final = "gymnasium:"
"""Start of the names of environments that are Gymnasium environments."""


@dataclass(frozen=True)
class Environment:
    """A simulator and what it is made from."""

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

    def simulator(self) -> Simulator:
        """Load the simulator plugin, or make the one of a Gymnasium environment.

        Raises:
            InputError: no simulator of this name is installed, or it takes no `observe` and
                `item_features`.
        """
        if self.name.startswith(GYMNASIUM):
            from ucfrec.evaluation.gymnasium_environment import gymnasium_simulator

            env_id = self.name.removeprefix(GYMNASIUM)
            return gymnasium_simulator(env_id, self.observe, self.item_features)
        if self.observe or self.item_features is not None:
            raise InputError(
                f"--observe and --item-features are for {GYMNASIUM}ID; leave them out for "
                f"{self.name}"
            )
        simulator: Simulator = load_plugin("simulators", self.name)
        return simulator
