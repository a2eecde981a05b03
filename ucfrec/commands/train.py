"""`ucfrec train`: a policy trained on a store."""

import argparse
from pathlib import Path

from ucfrec.policies.registry import policy_names


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `train` takes, here and on a sibling's command line."""
    parser.epilog = "every setting, its range and meaning: ucfrec settings --policy NAME"
    parser.add_argument("store", type=Path, metavar="STORE")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN")
    parser.add_argument(
        "--policy", default="ucf", metavar="NAME", help=f"{', '.join(policy_names())} (ucf)"
    )
    parser.add_argument("--config", type=Path, metavar="TOML", help="settings, a table a section")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="TABLE.FIELD=VALUE",
        help="a setting, over those of --config, as in train.steps=2000; repeatable",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, help="CPU threads (all)")


def run(options: argparse.Namespace) -> None:
    """`ucfrec train`."""
    import torch

    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.runs.config import resolve_config
    from ucfrec.runs.run import describe_run, train_run

    if options.threads is not None:
        torch.set_num_threads(options.threads)
    config = resolve_config(options.policy, options.config, options.set, options.seed)
    record = train_run(EpisodeStore.open(options.store), options.out, config)
    print(describe_run(record))
    print(f"\nrun: {options.out}; TensorBoard reads it too")
