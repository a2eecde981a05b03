"""Options that several commands share, and the objects made from them."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ucfrec.evaluation.world import World
    from ucfrec.logs.mapping import Dataset, LogMapping
    from ucfrec.runs.trained_policy import TrainedPolicy


def world_options(parser: argparse.ArgumentParser) -> None:
    """Add --env with the options that belong to it, and --seed."""
    env_options(parser, required=True)
    parser.add_argument("--seed", type=int, default=0, help="seed of the sessions (default: 0)")


def env_options(parser: argparse.ArgumentParser, required: bool, use: str = "") -> None:
    """Add --env, --env-folder, --observe and --item-features.

    Args:
        required: whether --env must be given.
        use: what the world is used for, for the help of --env.
    """
    parser.add_argument(
        "--env",
        required=required,
        help=f"simulator, e.g. synthetic-taobao, or gymnasium:ID, any Gymnasium environment "
        f"(gymnasium:MODULE:ID imports MODULE first){use}",
    )
    parser.add_argument(
        "--env-folder",
        type=Path,
        metavar="FOLDER",
        help="folder with the simulator's files, e.g. its weights (default: none)",
    )
    parser.add_argument(
        "--observe",
        default="",
        metavar="KEY[,KEY…]",
        help="of gymnasium:ID with a dict observation: entries that are observed, one after the "
        "other as one vector (default: none, states come from the items shown and their rewards; "
        "worlds of vector actions need one)",
    )
    parser.add_argument(
        "--item-features",
        metavar="SOURCE",
        help="of gymnasium:ID with items: their features, from an attribute of the environment or "
        "a file .npy (a row for each item) or .parquet (with a column item_id from 0) (default: "
        "none)",
    )


def log_options(parser: argparse.ArgumentParser) -> None:
    """Add LOGS, --dataset, --column and --mapping."""
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="LOGS",
        help="log files (.parquet, .csv, .csv.gz), folders or globs",
    )
    parser.add_argument(
        "--dataset",
        default="generic",
        metavar="NAME",
        help="kind of logs: generic, kuairand, kuairec, obd, … (default: generic)",
    )
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="file column or SQL expression for a log column, e.g. user_id=uid; repeatable "
        "(default: the column of the same name)",
    )
    parser.add_argument(
        "--mapping",
        type=Path,
        metavar="TOML",
        help="file with column mapping, reward and feature tables; --column overrides it "
        "(default: none)",
    )


def target_options(parser: argparse.ArgumentParser) -> None:
    """Add --checkpoint, --target-return and --target-quantile."""
    parser.add_argument(
        "--checkpoint",
        choices=["best", "last"],
        default="best",
        help="policy weights: of the lowest validation loss, or the last ones (default: best)",
    )
    parser.add_argument(
        "--target-return",
        type=float,
        metavar="RETURN",
        help="target return of an episode, in units of the reward (default: by --target-quantile)",
    )
    parser.add_argument(
        "--target-quantile",
        type=float,
        default=1.0,
        metavar="QUANTILE",
        help="without --target-return: this quantile of the training returns, 0 to 1 "
        "(default: 1, the largest)",
    )


def logs_given(options: argparse.Namespace) -> "tuple[tuple[Path, ...], LogMapping]":
    """Log files and full column mapping that `log_options` name.

    Raises:
        InputError: a file is missing, or the dataset, a --column or the mapping file is unusable.
    """
    from ucfrec.logs.mapping import LogMapping, columns_given, read_mapping
    from ucfrec.plugins import load_plugin

    dataset: Dataset = load_plugin("datasets", options.dataset)
    given = LogMapping(columns_given(options.column))
    if options.mapping is not None:
        given = given.over(read_mapping(options.mapping))
    return dataset.resolve(options.logs, given)


def world_given(options: argparse.Namespace) -> "World":
    """The world that `env_options` name."""
    from ucfrec.evaluation.world import World

    observe = tuple(key for key in options.observe.split(",") if key)
    features = options.item_features
    return World(options.env, options.env_folder, observe=observe, item_features=features)


def target_given(options: argparse.Namespace, trained: "TrainedPolicy") -> float:
    """Target return (reward units) that `target_options` name."""
    if options.target_return is not None:
        return float(options.target_return)
    return trained.target_return(options.target_quantile)
