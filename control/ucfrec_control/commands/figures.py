"""`ucfrec-control figures`: figures of runs and result rows."""

import argparse
import sys
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `figures`."""
    parser.add_argument(
        "--runs", nargs="*", type=Path, default=[], metavar="RUN", help="runs, or folders of runs"
    )
    parser.add_argument("--results", nargs="*", type=Path, default=[], metavar="ROWS")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec-control figures`."""
    from ucfrec_control.figures.figures import (
        make_figures,  # matplotlib takes half a second to import
    )

    files, missing = make_figures(options.runs, options.results, options.out)
    print("\n".join(map(str, files)))
    for line in missing:
        print(f"missing: {line}", file=sys.stderr)
