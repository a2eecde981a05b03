"""`ucfrec-control screen`: which state dimensions have an effect."""

import argparse
import dataclasses
from pathlib import Path

from ucfrec.commands.grid_options import seed_given
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import write_json
from ucfrec.provenance import provenance
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.training.screening import screen_store


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `screen`."""
    parser.add_argument("store", type=Path, metavar="STORE")
    parser.add_argument("--seed", type=seed_given, default=0)
    parser.add_argument("--json", type=Path, help="write the report here")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control screen`."""
    report = screen_store(EpisodeStore.open(options.store), options.seed)
    print(report.describe())
    if options.json is not None:
        write_json(options.json, dataclasses.asdict(report) | provenance(PACKAGES))
