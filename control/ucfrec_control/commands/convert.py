"""`ucfrec-control convert`: D4RL HDF5 to Minari, or back."""

from pathlib import Path
from typing import Annotated

from ucfrec.commands.options import ARGUMENT
from ucfrec.errors import InputError
from ucfrec_control.commands.options import SourceOptions, describe_source
from ucfrec_control.data.d4rl import write_d4rl
from ucfrec_control.data.minari import write_minari


class Convert(SourceOptions):
    """`ucfrec-control convert`."""

    target: Annotated[str, ARGUMENT]
    """FILE.hdf5, or a Minari identifier such as hopper/mine-v0."""

    def execute(self) -> None:
        """Run `ucfrec-control convert`."""
        trajectories = self.read_source()
        if self.target.endswith((".hdf5", ".h5")):
            written = Path(self.target)
            if written.exists():
                raise InputError(f"{written} exists already; remove it or name another file")
            write_d4rl(trajectories, written)
        else:
            written = write_minari(trajectories, self.target)
        print(f"{describe_source(trajectories)}\n\nwritten: {written}")
