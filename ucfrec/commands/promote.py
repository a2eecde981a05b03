"""`ucfrec promote`: which run of a folder `ucfrec serve` answers with."""

import argparse
from pathlib import Path

from ucfrec.commands.options import option


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec promote`."""
    option(
        parser,
        "run",
        Path,
        "run folder that becomes the current one of the folder that it lies in; with --back, "
        "that folder",
        "RUN",
    )
    how = parser.add_mutually_exclusive_group()
    option(
        how,
        "--force",
        False,
        "promote a run without a verdict against the current one, or a worse one (default: refuse)",
    )
    option(how, "--back", False, "return to the run that was current before")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec promote` and print which run is current.

    Raises:
        InputError: the run cannot be promoted, or there is none to return to.
    """
    from ucfrec.files.record import RUN_RECORD
    from ucfrec.runs.promoted import POINTER, promote, promote_back

    if options.back:
        folder = options.run.parent if (options.run / RUN_RECORD).is_file() else options.run
        pointer = promote_back(folder)
    else:
        folder, pointer = options.run.resolve().parent, promote(options.run, options.force)
    before = f", before it {pointer.previous[-1]}" if pointer.previous else ""
    print(f"current run: {pointer.current}{before} ({folder / POINTER})")
    if not options.back:
        print(f"next: ucfrec serve {folder}, which follows it; --back returns")
