"""`ucfrec-control collect`: datasets from SAC, which resumes, or from a saved agent."""

from pathlib import Path
from typing import Annotated, Any

from ucfrec.commands.options import SEED, Table
from ucfrec.errors import InputError
from ucfrec.reporting.tables import format_rows
from ucfrec_control.data.collect import SHOWN, CollectConfig, collect, collect_agent


class Collect(Table):
    """`ucfrec-control collect`."""

    env: str
    """Gymnasium environment, e.g. Hopper-v5."""
    out: Annotated[Path, "FOLDER"]
    """Folder of the files."""
    steps: int = 1_000_000
    """Of training."""
    every: int = 10_000
    """Steps between evaluations."""
    fraction: float = 1 / 3
    """Of the expert's return, for medium."""
    size: int = 1_000_000
    """Steps of medium and of expert."""
    seed: Annotated[int, SEED] = 0
    """Of everything random."""
    agent: Annotated[Path | None, "ZIP"] = None
    """Record this agent, saved by Stable-Baselines3, instead of training one; pickled parts of the
    file are not read"""
    noise: float = 0.0
    """Standard deviation of the noise on the agent's actions, in halves of their range."""

    def execute(self) -> None:
        """Run `ucfrec-control collect`."""
        if self.agent is not None:
            acting: dict[str, Any] = {"noise": self.noise, "size": self.size, "seed": self.seed}
            rows = [collect_agent(self.agent, self.env, self.out, **acting)]
        elif self.noise:
            raise InputError("--noise is for the actions of an --agent")
        else:
            config = CollectConfig(
                steps=self.steps, every=self.every, fraction=self.fraction, size=self.size
            )
            rows = collect(self.env, self.out, self.seed, config)
        print(format_rows(rows, SHOWN))
        print(f"\nfiles: {self.out}")
