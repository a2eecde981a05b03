"""The command-line parser, which imports only the module of the called command.

These modules import heavy dependencies inside `run`, so that `--help` answers at once and no
command loads what only another one needs.
"""

import argparse
import os
import re
import sys
import textwrap
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module, metadata
from typing import Any

from ucfrec import __version__
from ucfrec.commands.options import Table, add_options
from ucfrec.errors import InputError, InputNote, explain_os_error, one_line
from ucfrec.files.remote import local_paths
from ucfrec.processes import Interrupted, interruptions_raised, keep_freed_memory


@dataclass(frozen=True)
class Program:
    """A command-line program with several commands."""

    name: str
    summary: str
    package: str
    """Package with the modules of the commands, each a `Table` called as the command."""
    commands: Mapping[str, str]
    """Command name to its line in `--help`, after the module and a colon if that differs."""
    sections: Mapping[str, str] = field(default_factory=dict)
    """First command of each section of `--help` to the title of the section."""


UCFREC = Program(
    "ucfrec",
    "Train recommendation policies from logs and estimate their value.",
    "ucfrec.commands",
    {
        "prepare": "turn logs into an episode store",
        "train": "train a policy on an episode store; resumes",
        "rank": "ope: measure how well policies rank items shown and clicked later",
        "ope": "estimate a policy's return from logs alone (off-policy evaluation)",
        "recommend": "recommend the next items to the users of a log",
        "serve": "recommend: answer requests for recommendations over HTTP",
        "report": "runs: write one HTML page about training runs",
        "join": "runs: join exposures with their feedback into a log",
        "update": "runs: train on from a run with new logs, and compare both; resumes",
        "compare": "runs: compare two runs that shared the traffic (A/B test)",
        "promote": "runs: make a run the one that `serve RUNS` uses",
        "demo": "run every step on simulated logs and write a report; resumes",
        "settings": "train: list every training setting, its default, range and meaning",
        "tune": "train: search the settings of a training; resumes",
        "evaluate": "benchmark: measure the return of policies in a simulator",
        "score": "ope: write a policy's probability of every logged choice",
        "explore": "recommend: try out one or two policies in the browser",
        "export": "recommend: write the policy with its rule as an ONNX graph",
        "verify": "runs: compare every file of stores and runs with its checksum",
        "datasets": "prepare: list public data sets, or download one",
        "collect": "benchmark: simulate sessions and write them as Parquet logs",
        "benchmark": "measure every method and print tables; resumes",
    },
    {"prepare": "from logs to recommendations", "join": "every day", "demo": "advanced"},
)


_FREE_MEMORY = ("Prepare", "Join", "Serve")
"""Commands that return freed memory, because they keep to a limit or run for days."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one `ucfrec` command.

    Args:
        arguments: command-line arguments without the program name; None for `sys.argv`.

    Returns:
        Exit status: 0 for success; 2 for an unusable input or an error of the operating system (one
        line on stderr says what to do); 130 after Ctrl-C and 143 after TERM. An interrupted command
        that is run again resumes or starts again; it leaves nothing half-written.
    """
    return run(UCFREC, arguments)


def run(program: Program, arguments: Sequence[str] | None) -> int:
    """Run one command of `program`; returns the exit status as `main` does."""
    arguments = sys.argv[1:] if arguments is None else arguments
    name = program.name
    try:
        with interruptions_raised(), notes_on_one_line(program.name):
            table, options = parse_command(program, arguments)
            name = f"{program.name} {table.__name__.lower()}"
            if table.__name__ not in _FREE_MEMORY:
                keep_freed_memory()
            with local_paths(options) as options:
                table(**vars(options)).execute()
            sys.stdout.flush()
    except Interrupted as interruption:
        if sys.stderr.isatty():
            print(file=sys.stderr)  # after ^C, or a progress bar
        print(
            f"{name}: interrupted; run the same command again to resume or restart", file=sys.stderr
        )
        return interruption.status
    except BrokenPipeError:
        # The reader of a pipe, such as `head`, closed it: that is not a failure.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        message = explanation(error)
        if message is None or "--debug" in arguments:
            raise
        print(one_line(f"{name}: {message}"), file=sys.stderr)
        return 2
    return 0


def explanation(error: BaseException) -> str | None:
    """What a user can do about an error, on one line; None if it is a bug of ucfrec."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError):
        return explain_os_error(error)
    if isinstance(error, ModuleNotFoundError) and (extra := _extra_with(error.name or "")):
        return f"{error.name} is not installed; install ucfrec[{extra}]"
    text = str(error)
    if isinstance(error, MemoryError) or re.search(_NO_MEMORY, text):
        reason = f" ({text})" if text else ""
        return (
            f"memory is exhausted{reason}; close other programs, raise the limit (ulimit -v), or "
            "use smaller settings"
        )
    if re.search(_NO_SPACE, text):
        return f"no space is left on a disk ({text}); free space and run again"
    return None


def _extra_with(module: str) -> str | None:
    """The smallest extra of ucfrec that brings a module which has the name of its distribution."""
    name = module.partition(".")[0].replace("_", "-").lower()
    lines = "\n".join(metadata.requires("ucfrec") or ()).lower()
    pairs = re.findall(r"(?m)^([\w-]+).*; extra == .(?!dev|docs)(\w+)", lines)
    sizes = Counter(extra for _, extra in pairs)
    suitable = [extra for package, extra in pairs if package == name]
    return min(suitable, key=lambda extra: sizes[extra], default=None)


_NO_MEMORY = (
    "DefaultCPUAllocator|std::bad_alloc|out of memory|Out of Memory|[cC]annot allocate memory|"
    "can't start new thread|failed to map segment|could not allocate|malloc of size|"
    "could not create a primitive"
)
"""How libraries that raise other errors than `MemoryError` say that there is no memory."""
_NO_SPACE = "No space left on device|Disk quota exceeded|File too large|disk is full|disk I/O error"
"""How libraries that raise other errors than `OSError` say that a disk is full."""


@contextmanager
def notes_on_one_line(name: str) -> Iterator[None]:
    """Print each `InputNote` as one line on stderr; other warnings as always."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", InputNote)
        show_other = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **how: Any) -> None:
            if issubclass(category, InputNote):
                print(one_line(f"{name}: note: {message}"), file=sys.stderr)
            else:
                show_other(message, category, *where, **how)

        warnings.showwarning = show
        yield


def parse_command(
    program: Program, arguments: Sequence[str]
) -> tuple[type[Table], argparse.Namespace]:
    """The table of the called command and its options, which may stand before, between and after
    runs and logs. Only its module is imported: those of all commands take seconds."""
    lines = [program.summary]
    for name, summary in program.commands.items():
        lines += [f"\n{program.sections[name]}:"] if name in program.sections else []
        lines.append(f"  {name:<12}{summary.rpartition(': ')[2]}")
    parser = argparse.ArgumentParser(
        prog=program.name,
        description="\n".join(lines),
        epilog=f"{program.name} COMMAND --help describes a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="%(prog)s [options] COMMAND …",
    )
    parser.add_argument("--version", action="version", version=f"ucfrec {__version__}")
    parser.add_argument("--debug", action="store_true", help="show tracebacks of input errors")
    parser.add_argument("command", metavar="COMMAND", choices=[*program.commands])
    parser.add_argument("words", metavar="…", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    called = parser.parse_args(arguments)
    module, _, summary = program.commands[called.command].rpartition(": ")
    command = argparse.ArgumentParser(
        prog=f"{program.name} {called.command}",
        description=summary,
        formatter_class=_Formatter,
        add_help=False,
        allow_abbrev=False,  # `--exclude FILE` would be `--exclude-seen`, and the file a log
    )
    package = import_module(f"{program.package}.{module or called.command}")
    table: type[Table] = getattr(package, called.command.capitalize())
    add_options(command, table, called.words)
    return table, command.parse_intermixed_args(called.words)


class _Formatter(argparse.HelpFormatter):
    """Does not break options at hyphens."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)


if __name__ == "__main__":
    sys.exit(main())
