"""`ucfrec demo`: everything on simulated logs, collect to report."""

import argparse
from pathlib import Path

from ucfrec.commands.demo_run import DemoConfig, demo
from ucfrec.reporting.tables import format_rows


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `demo` takes."""
    parser.add_argument("--out", type=Path, default=Path("demo-out"), help="folder (demo-out)")
    parser.add_argument("--seed", type=int, default=0)


def run(options: argparse.Namespace) -> None:
    """`ucfrec demo`."""
    rows = demo(options.out, options.seed, DemoConfig())
    print(format_rows(rows))
    print(f"\nreport: {options.out / 'report.html'}; rows, logs, stores and runs lie beside it")
