"""`ucfrec report`: write one HTML page about training runs."""

import argparse
from pathlib import Path

from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec report`."""
    parser.add_argument(
        "runs", nargs="*", type=Path, metavar="RUN", help="run folders of `ucfrec train`"
    )
    parser.add_argument(
        "--results",
        nargs="+",
        action="extend",
        type=Path,
        default=[],
        metavar="FILE",
        help="results to show: JSON or JSON lines (.jsonl) of `ucfrec evaluate --json`, "
        "`ucfrec ope --json` or `ucfrec demo` (default: none)",
    )
    parser.add_argument(
        "--items",
        type=Path,
        metavar="FILE",
        help="item features to show with the sample recommendations: Parquet or CSV with a column "
        "item_id (default: none)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("report.html"),
        metavar="FILE",
        help="HTML file to write (default: report.html)",
    )
    parser.usage = "%(prog)s RUN... [options]"


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec report`.

    Raises:
        InputError: no run is named, or a run, result or item file cannot be used.
    """
    from ucfrec.reporting.page import write_report
    from ucfrec.runs.record import RUN

    # A run that follows `--results FILE` is still a run.
    runs = [*options.runs, *(path for path in options.results if (path / RUN).is_file())]
    if not runs:
        raise InputError("name a run folder of `ucfrec train`")
    results = [path for path in options.results if path not in runs]
    write_report(options.out, runs, results, options.items)
    print(f"report: {options.out}; open it in a browser")
