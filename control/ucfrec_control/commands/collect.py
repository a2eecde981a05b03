"""`ucfrec-control collect`: a dataset of a saved agent."""

from pathlib import Path
from typing import Annotated

from ucfrec.commands.options import SEED, Table
from ucfrec.reporting.tables import format_rows
from ucfrec_control.data.collect import SHOWN, collect_agent


class Collect(Table):
    """`ucfrec-control collect`."""

    agent: Annotated[Path, "ZIP"]
    """Agent, saved by Stable-Baselines3; pickled parts of the file are not read."""
    env: str
    """Gymnasium environment, e.g. Hopper-v5."""
    out: Path
    """Folder of the file."""
    size: int = 1_000_000
    """Steps."""
    seed: Annotated[int, SEED] = 0
    """Of everything random."""
    noise: float = 0.0
    """Standard deviation of the noise on the agent's actions, in halves of their range."""

    def execute(self) -> None:
        """Run `ucfrec-control collect`."""
        row = collect_agent(
            self.agent, self.env, self.out, noise=self.noise, size=self.size, seed=self.seed
        )
        print(format_rows([row], SHOWN))
        print(f"\nfiles: {self.out}")
