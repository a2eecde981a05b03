"""Options that several commands share, and what they stand for."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ucfrec.logs.mapping import Dataset, LogMapping
    from ucfrec.runs.trained_policy import TrainedPolicy


def world_options(parser: argparse.ArgumentParser) -> None:
    """A simulated world and the seed of its sessions."""
    parser.add_argument("--env", required=True, help="simulator, e.g. synthetic-taobao")
    parser.add_argument("--env-folder", type=Path, help="folder of the simulator's weights")
    parser.add_argument("--seed", type=int, default=0)


def log_options(parser: argparse.ArgumentParser) -> None:
    """Where logs are and what their columns mean: every command that reads them."""
    parser.add_argument("logs", nargs="+", metavar="LOGS", help="files, folders or globs")
    parser.add_argument("--dataset", default="generic", help="generic (default), kuairand, …")
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="where a log column is found, e.g. user_id=uid; repeatable",
    )
    parser.add_argument("--mapping", type=Path, metavar="TOML", help="column mapping as TOML")


def target_options(parser: argparse.ArgumentParser) -> None:
    """Which weights act, and their target return."""
    parser.add_argument("--checkpoint", choices=["best", "last"], default="best")
    parser.add_argument("--target-return", type=float, help="target return of an episode")
    parser.add_argument(
        "--target-quantile",
        type=float,
        default=1.0,
        help="else this quantile of the training returns (1: the largest)",
    )


def logs_given(options: argparse.Namespace) -> "tuple[tuple[Path, ...], LogMapping]":
    """Files and column mapping of a command that reads logs."""
    from ucfrec.logs.mapping import LogMapping, columns_given, read_mapping
    from ucfrec.plugins import load_plugin

    dataset: Dataset = load_plugin("datasets", options.dataset)
    given = LogMapping(columns_given(options.column))
    if options.mapping is not None:
        given = given.over(read_mapping(options.mapping))
    return dataset.resolve(options.logs, given)


def target_given(options: argparse.Namespace, trained: "TrainedPolicy") -> float:
    """The target return that `target_options` name."""
    if options.target_return is not None:
        return float(options.target_return)
    return trained.target_return(options.target_quantile)
