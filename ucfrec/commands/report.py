"""`ucfrec report`: write one HTML page about training runs."""

import argparse
from pathlib import Path

from ucfrec.commands.options import option
from ucfrec.errors import InputError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec report`."""
    option(parser, "runs", Path, "run folders of `ucfrec train`", "RUN", nargs="*")
    option(
        parser,
        "--results",
        Path,
        "results to show: JSON or JSON lines (.jsonl) of `ucfrec evaluate --json`, "
        "`ucfrec ope --json` or `ucfrec demo` (default: none)",
        "FILE",
        nargs="+",
        action="extend",
        default=[],
    )
    option(
        parser,
        "--items",
        Path,
        "item features to show with the sample recommendations: Parquet or CSV with a column "
        "item_id (default: none)",
        "FILE",
    )
    text = "HTML file to write (default: report.html)"
    option(parser, "--out", Path, text, "FILE", default=Path("report.html"))
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
