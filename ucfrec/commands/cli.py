"""The command line. Only the module of the command that is called is imported.

Such a module imports what its command works with inside `run`, so that `--help` answers at once
and no command loads what only another one needs.
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
    """A command line of several commands."""

    name: str
    summary: str
    package: str
    """Holds one module a command, with `add_options(parser)` and `run(options)`."""
    commands: Mapping[str, str]
    """One line for `--help`, by the command's name."""


UCFREC = Program(
    "ucfrec",
    "Train recommender policies from Parquet logs and judge what they would earn.",
    "ucfrec.commands",
    {
        "demo": "everything on simulated logs, ends in a report",
        "collect": "play sessions in a simulator, as Parquet logs",
        "prepare": "logs to an episode store",
        "train": "train a policy on a store; resumes",
        "settings": "every setting of a training: default, range, meaning",
        "evaluate": "what a policy earns in a simulator",
        "recommend": "the next items for users of a log",
        "score": "a policy's probability of every choice of a log",
        "ope": "what a policy would have earned, from logs alone",
        "report": "one HTML page about runs",
        "benchmark": "tables of every method; resumes",
    },
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status.

    0 is success, 2 an input that cannot be used (one line on stderr says what to do), 130 an
    interruption; a command that was interrupted goes on where it was when given again.
    """
    return run(UCFREC, arguments)


def run(program: Program, arguments: Sequence[str] | None) -> int:
    """Run one command of `program`, this one or a sibling's; `main` tells the status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = build_parser(program, arguments).parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    name = f"{program.name} {options.command}"
    try:
        _module(program, options.command).run(options)
    except InputError as error:
        return _failed(options, f"{name}: {error}")
    except BrokenPipeError:
        # Whoever read the output, as `head` does, has read enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
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


def build_parser(program: Program, arguments: Sequence[str]) -> argparse.ArgumentParser:
    """All commands, and the options of the one that `arguments` call.

    The others' are left out: their modules would have to be imported, which takes seconds.
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
    """What a module of a command has."""

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
