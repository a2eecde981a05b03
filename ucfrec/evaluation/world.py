"""Simulated worlds by name."""

from dataclasses import dataclass
from pathlib import Path

from ucfrec.plugins import Simulator, load_plugin


@dataclass(frozen=True)
class World:
    """A simulator and the folder of its weights."""

    name: str
    """Name of a simulator plugin."""
    folder: Path | None = None
    """Folder of the simulator's weights; None if it needs none."""

    def simulator(self) -> Simulator:
        """Load the simulator plugin.

        Raises:
            InputError: no simulator of this name is installed.
        """
        simulator: Simulator = load_plugin("simulators", self.name)
        return simulator
