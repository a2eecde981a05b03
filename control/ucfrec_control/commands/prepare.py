"""`ucfrec-control prepare`: a dataset to an episode store."""

import argparse
from pathlib import Path

from ucfrec_control.commands.options import describe_source, read_source, source_options


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `prepare`."""
    source_options(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="STORE")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control prepare`."""
    trajectories = read_source(options)
    trajectories.write_store(options.out)
    print(f"{describe_source(trajectories)}\n\nstore: {options.out}")
