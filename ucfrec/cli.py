"""The command line. Heavy imports wait until a command is known."""

import argparse
import errno
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ucfrec import __version__
from ucfrec.errors import InputError

Commands = Mapping[str, Callable[[argparse.Namespace], Any]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status.

    0 is success, 2 an input that cannot be used (one line on stderr says what to do), 130 an
    interruption; a command that was interrupted goes on where it was when given again.
    """

    def commands() -> Commands:
        from ucfrec.commands import COMMANDS

        return COMMANDS

    return run(build_parser(), commands, arguments)


def run(
    parser: argparse.ArgumentParser,
    commands: Callable[[], Commands],
    arguments: Sequence[str] | None,
) -> int:
    """Run one of `commands`, of this or of a sibling's command line; `main` tells the status.

    Args:
        parser: with options `command` and `debug`.
        commands: called once a command is known, so that heavy imports wait until then.
    """
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    name = f"{parser.prog} {options.command}"
    try:
        commands()[options.command](options)
    except InputError as error:
        return _failed(options, f"{name}: {error}")
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        where = f" for {error.filename}" if error.filename else ""
        message = f"no space is left on disk{where}; nothing was written. Free some and run again"
        return _failed(options, f"{name}: {message}")
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        return 130
    return 0


def _failed(options: argparse.Namespace, message: str) -> int:
    if options.debug:
        raise
    print(message, file=sys.stderr)
    return 2


def build_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = argparse.ArgumentParser(
        prog="ucfrec",
        description="Train recommender policies from Parquet logs and judge what they would earn.",
    )
    parser.add_argument("--version", action="version", version=f"ucfrec {__version__}")
    parser.add_argument("--debug", action="store_true", help="show tracebacks of input errors")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _demo(commands.add_parser("demo", help="everything on simulated logs, ends in a report"))
    _collect(commands.add_parser("collect", help="play sessions in a simulator, as Parquet logs"))
    _prepare(commands.add_parser("prepare", help="logs to an episode store"))
    train_options(commands.add_parser("train", help="train a policy on a store; resumes"))
    _evaluate(commands.add_parser("evaluate", help="what a policy earns in a simulator"))
    _recommend(commands.add_parser("recommend", help="the next items for users of a log"))
    _score(commands.add_parser("score", help="a policy's probability of every choice of a log"))
    _ope(commands.add_parser("ope", help="what a policy would have earned, from logs alone"))
    _report(commands.add_parser("report", help="one HTML page about runs"))
    _benchmark(commands.add_parser("benchmark", help="tables of every method; resumes"))
    return parser


def _demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("demo-out"), help="folder (demo-out)")
    parser.add_argument("--seed", type=int, default=0)


def _world_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env", required=True, help="simulator, e.g. synthetic-taobao")
    parser.add_argument("--env-folder", type=Path, help="folder of the simulator's weights")
    parser.add_argument("--seed", type=int, default=0)


def _collect(parser: argparse.ArgumentParser) -> None:
    _world_options(parser)
    parser.add_argument("--behavior", default="mixture", help="logging policy (mixture)")
    parser.add_argument("--sessions", type=int, default=20_000)
    parser.add_argument("--out", type=Path, required=True, help="new folder for the logs")


def _log_options(parser: argparse.ArgumentParser) -> None:
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


def _prepare(parser: argparse.ArgumentParser) -> None:
    _log_options(parser)
    parser.add_argument("--out", type=Path, metavar="STORE", help="new folder for the store")
    parser.add_argument("--reward", help="SQL over feedback columns, e.g. is_click")
    parser.add_argument(
        "--session-by", choices=["gap", "user", "session_id"], help="how rows make sessions"
    )
    parser.add_argument("--gap-minutes", type=float, help="pause that ends a session (30)")
    parser.add_argument(
        "--split", metavar="TRAIN,VALIDATION,TEST", help="shares in order of time (0.8,0.1,0.1)"
    )
    parser.add_argument("--validate", action="store_true", help="only check, write nothing")


def train_options(parser: argparse.ArgumentParser) -> None:
    """What `train` takes, here and on a sibling's command line."""
    parser.add_argument("store", type=Path, metavar="STORE")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN")
    parser.add_argument("--policy", default="ucf", help="ucf (default) or a baseline: dt, bc, …")
    parser.add_argument("--config", type=Path, metavar="TOML")
    parser.add_argument("--set", action="append", default=[], metavar="TABLE.FIELD=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, help="CPU threads (all)")


def _target_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--checkpoint", choices=["best", "last"], default="best")
    parser.add_argument("--target-return", type=float, help="return asked of an episode")
    parser.add_argument(
        "--target-quantile",
        type=float,
        default=1.0,
        help="else this quantile of the training returns (1: the largest)",
    )


def _evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN")
    _world_options(parser)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument(
        "--behavior",
        action="append",
        default=[],
        help="a built-in policy to judge beside, e.g. random; repeatable",
    )
    _target_options(parser)
    parser.add_argument("--json", type=Path, help="write the result rows here")


def _recommend(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN")
    _log_options(parser)
    parser.add_argument("--k", type=int, default=10, help="items a user (10)")
    parser.add_argument("--keep-seen", action="store_true", help="seen items may come again")
    parser.add_argument(
        "--skip-unknown", action="store_true", help="ignore rows of items the run never saw"
    )
    _target_options(parser)
    parser.add_argument("--out", type=Path, required=True, help="Parquet file")


def _score(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN")
    _log_options(parser)
    _target_options(parser)
    parser.add_argument("--out", type=Path, required=True, help="Parquet file")


def _ope(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN")
    _log_options(parser)
    _target_options(parser)
    parser.add_argument(
        "--greedy", action="store_true", help="judge the most probable item, not the softmax"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the result rows here")


def _report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument(
        "--results",
        nargs="+",
        action="extend",
        type=Path,
        default=[],
        metavar="FILE",
        help="rows of `ucfrec evaluate --json` or of the demo, JSON or JSON lines",
    )
    parser.add_argument("--out", type=Path, default=Path("report.html"), help="(report.html)")


def _benchmark(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("suite", help="recommendation, or one that a package announces")
    parser.add_argument("--budget", choices=["small", "full"], default="small")
    parser.add_argument("--table", action="append", default=[], help="only this one; repeatable")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"), help="logs and runs")
    parser.add_argument(
        "--results", type=Path, help="JSON lines (benchmarks/results/SUITE.jsonl); appended to"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")


if __name__ == "__main__":
    sys.exit(main())
