"""`ucfrec-control prepare`: a dataset to an episode store."""

from pathlib import Path
from typing import Annotated

from ucfrec_control.commands.options import SourceOptions, describe_source


class Prepare(SourceOptions):
    """`ucfrec-control prepare`."""

    out: Annotated[Path, "STORE"]
    """Folder of the store."""

    def execute(self) -> None:
        """Run `ucfrec-control prepare`."""
        trajectories = self.read_source()
        trajectories.write_store(self.out)
        print(f"{describe_source(trajectories)}\n\nstore: {self.out}")
