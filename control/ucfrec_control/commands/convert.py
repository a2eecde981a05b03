"""`ucfrec-control convert`: D4RL HDF5 to Minari, or back."""

import argparse
from pathlib import Path

from ucfrec.errors import InputError
from ucfrec_control.commands.options import describe_source, read_source, source_options
from ucfrec_control.data.d4rl import write_d4rl
from ucfrec_control.data.minari import write_minari


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `convert`."""
    source_options(parser)
    parser.add_argument(
        "target", metavar="TARGET", help="FILE.hdf5, or a Minari identifier such as hopper/mine-v0"
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control convert`."""
    trajectories = read_source(options)
    if options.target.endswith((".hdf5", ".h5")):
        written = Path(options.target)
        if written.exists():
            raise InputError(f"{written} exists already; remove it or name another file")
        write_d4rl(trajectories, written)
    else:
        written = write_minari(trajectories, options.target)
    print(f"{describe_source(trajectories)}\n\nwritten: {written}")
