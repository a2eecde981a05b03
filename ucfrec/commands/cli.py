"""The command-line parser, which imports only the module of the called command.

Command modules import heavy dependencies inside `run`, so that `--help` answers at once and no
command loads what only another one needs.
"""

import argparse
import errno
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Protocol, cast

from ucfrec import __version__
from ucfrec.errors import InputError


@dataclass(frozen=True)
class Program:
    """A command-line program with several commands."""

    name: str
    summary: str
    package: str
    """Package with one module per command, each with `add_options(parser)` and `run(options)`."""
    commands: Mapping[str, str]
    """Command name to its one-line summary in `--help`."""


UCFREC = Program(
    "ucfrec",
    "Train recommender policies from Parquet logs and estimate the return they would earn.",
    "ucfrec.commands",
    {
        "demo": "run every step on simulated logs and write a report; resumes",
        "collect": "simulate sessions and write them as Parquet logs",
        "prepare": "turn logs into an episode store",
        "train": "train a policy on an episode store; resumes",
        "settings": "list every training setting: default, range, meaning",
        "evaluate": "measure the return of policies in a simulator",
        "rank": "measure how well policies rank items shown and clicked later",
        "recommend": "recommend the next items to the users of a log",
        "score": "write a policy's probability of every logged choice",
        "ope": "estimate a policy's return from logs alone (off-policy evaluation)",
        "verify": "compare every file of stores and runs with its checksum",
        "report": "write one HTML page about training runs",
        "benchmark": "measure every method and print tables; resumes",
    },
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one `ucfrec` command.

    Args:
        arguments: command-line arguments without the program name; None for `sys.argv`.

    Returns:
        Exit status: 0 for success, 2 for an unusable input or a full disk (one line on stderr says
        what to do), 130 for an interruption. An interrupted command that is run again resumes.
    """
    return run(UCFREC, arguments)


def run(program: Program, arguments: Sequence[str] | None) -> int:
    """Run one command of `program`; returns the exit status as `main` does."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = build_parser(program, arguments).parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    name = f"{program.name} {options.command}"
    try:
        _module(program, options.command).run(options)
    except InputError as error:
        return _failed(options, f"{name}: {error}")
    except BrokenPipeError:
        # The reader of a pipe, such as `head`, closed it: that is no failure.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        where = f" for {error.filename}" if error.filename else ""
        message = f"no space is left on disk{where}; nothing was written. Free space and run again"
        return _failed(options, f"{name}: {message}")
    except KeyboardInterrupt:
        print(
            "\ninterrupted; run the same command again to resume from the last checkpoint",
            file=sys.stderr,
        )
        return 130
    return 0


def build_parser(program: Program, arguments: Sequence[str]) -> argparse.ArgumentParser:
    """Parser of all commands, with the options of only the command that `arguments` name.

    Options of the other commands would need their modules, whose imports take seconds.
    """
    parser = argparse.ArgumentParser(prog=program.name, description=program.summary)
    parser.add_argument("--version", action="version", version=f"ucfrec {__version__}")
    parser.add_argument("--debug", action="store_true", help="show tracebacks of input errors")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    called = next((word for word in arguments if word in program.commands), None)
    for name, summary in program.commands.items():
        command = commands.add_parser(name, help=summary, description=summary)
        if name == called:
            _module(program, name).add_options(command)
    return parser


class _Command(Protocol):
    """Interface of a command module."""

    def add_options(self, parser: argparse.ArgumentParser) -> None: ...

    def run(self, options: argparse.Namespace) -> None: ...


def _module(program: Program, command: str) -> _Command:
    return cast(_Command, import_module(f"{program.package}.{command.replace('-', '_')}"))


def _failed(options: argparse.Namespace, message: str) -> int:
    if options.debug:
        raise
    print(message, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
