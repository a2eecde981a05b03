"""`ucfrec promote`: which run of a folder `ucfrec serve` answers with."""

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec promote`."""
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN",
        help="run folder that becomes the current one of the folder that it lies in; with --back, "
        "that folder",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--force",
        action="store_true",
        help="promote a run without a verdict against the current one, or a worse one (default: "
        "refuse)",
    )
    how.add_argument(
        "--back", action="store_true", help="return to the run that was current before"
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec promote` and print which run is current.

    Raises:
        InputError: the run cannot be promoted, or there is none to return to.
    """
    from ucfrec.files.record import RUN_RECORD
    from ucfrec.runs.promoted import POINTER, promote, promote_back

    if options.back:
        folder = options.run.parent if (options.run / RUN_RECORD).is_file() else options.run
        found = promote_back(folder)
    else:
        folder, found = options.run.resolve().parent, promote(options.run, options.force)
    before = f", before it {found.previous[-1]}" if found.previous else ""
    print(f"current run: {found.current}{before} ({folder / POINTER})")
    if not options.back:
        print(f"next: ucfrec serve {folder}, which follows it; --back returns")
