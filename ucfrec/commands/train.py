"""`ucfrec train`: a policy trained on a store."""

import argparse
from pathlib import Path

import torch

from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import describe_run, train_run


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `train` takes, here and on a sibling's command line."""
    parser.add_argument("store", type=Path, metavar="STORE")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN")
    parser.add_argument("--policy", default="ucf", help="ucf (default) or a baseline: dt, bc, …")
    parser.add_argument("--config", type=Path, metavar="TOML")
    parser.add_argument("--set", action="append", default=[], metavar="TABLE.FIELD=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, help="CPU threads (all)")


def run(options: argparse.Namespace) -> None:
    """`ucfrec train`."""
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    config = resolve_config(options.policy, options.config, options.set, options.seed)
    record = train_run(EpisodeStore.open(options.store), options.out, config)
    print(describe_run(record))
    print(f"\nrun: {options.out}; TensorBoard reads it too")
