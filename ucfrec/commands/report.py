"""`ucfrec report`: one HTML page about runs."""

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `report` takes."""
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument(
        "--results",
        nargs="+",
        action="extend",
        type=Path,
        default=[],
        metavar="FILE",
        help="rows that `ucfrec evaluate`, `ucfrec ope` or the demo wrote, JSON or JSON lines",
    )
    parser.add_argument(
        "--items",
        type=Path,
        metavar="FILE",
        help="item features to show beside sample recommendations, Parquet or CSV with item_id",
    )
    parser.add_argument("--out", type=Path, default=Path("report.html"), help="(report.html)")


def run(options: argparse.Namespace) -> None:
    """`ucfrec report`."""
    from ucfrec.reporting.page import write_report

    write_report(options.out, options.runs, options.results, options.items)
    print(f"report: {options.out}; open it in a browser")
