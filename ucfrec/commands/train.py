"""`ucfrec train`: train a policy on an episode store."""

import argparse
from pathlib import Path

from ucfrec.policies.registry import policy_names


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `train`, for `ucfrec` and for other programs with this command."""
    parser.epilog = "Every setting, its range and meaning: ucfrec settings --policy NAME"
    parser.add_argument("store", type=Path, metavar="STORE", help="episode store to train on")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="RUN",
        help="folder of the run; an unfinished run in it is resumed",
    )
    parser.add_argument(
        "--policy",
        default="ucf",
        metavar="NAME",
        help=f"learner: {', '.join(policy_names())} (default: ucf)",
    )
    parser.add_argument(
        "--config",
        type=Path,
        metavar="TOML",
        help="file of settings with one table per section (default: none)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="TABLE.FIELD=VALUE",
        help="one setting, e.g. train.steps=2000; overrides --config; repeatable (default: none)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of weights and batches (default: 0)"
    )
    parser.add_argument("--threads", type=int, help="CPU threads (default: all cores)")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec train`.

    Raises:
        InputError: the store or a setting cannot be used, or --out holds a different run.
    """
    import torch

    from ucfrec.episodes.store import EpisodeStore
    from ucfrec.reporting.model_card import write_card
    from ucfrec.runs.config import resolve_config
    from ucfrec.runs.run import describe_run, train_run

    if options.threads is not None:
        torch.set_num_threads(options.threads)
    config = resolve_config(options.policy, options.config, options.set, options.seed)
    record = train_run(EpisodeStore.open(options.store), options.out, config)
    card = write_card(options.out)
    print(describe_run(record))
    print(f"\nrun: {options.out}; TensorBoard can open it\nmodel card: {card}")
