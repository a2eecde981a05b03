"""Simulated worlds by name."""

from dataclasses import dataclass
from pathlib import Path

from ucfrec.plugins import Simulator, load_plugin


@dataclass(frozen=True)
class World:
    """A simulator by name, with where its weights are."""

    name: str
    folder: Path | None = None

    def simulator(self) -> Simulator:
        """Load the simulator that the name stands for."""
        simulator: Simulator = load_plugin("simulators", self.name)
        return simulator
