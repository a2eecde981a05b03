"""`ucfrec-control distract`: a store with a distractor in its states."""

import argparse
from pathlib import Path

from ucfrec.commands.grid_options import seed_given
from ucfrec.episodes.store import EpisodeStore
from ucfrec_control.data.distractor import add_distractor


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `distract`."""
    parser.add_argument("store", type=Path, metavar="STORE")
    parser.add_argument("--out", type=Path, required=True, metavar="STORE")
    parser.add_argument("--flip", type=float, default=0.0, help="probability that it is wrong (0)")
    parser.add_argument("--early", action="store_true", help="indicate the next step's reward")
    parser.add_argument("--seed", type=seed_given, default=0)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control distract`."""
    store = EpisodeStore.open(options.store)
    add_distractor(store, options.out, options.flip, options.seed, options.early)
    print(f"store: {options.out}; dimension {store.observation_size} is the distractor")
