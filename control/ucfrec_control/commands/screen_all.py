"""`ucfrec-control screen-all`: screening of every zoo file, distracted; resumes."""

import argparse

from ucfrec.provenance import format_rows
from ucfrec_control.benchmark.screening_table import SHOWN as SHOWN_SCREENING
from ucfrec_control.benchmark.screening_table import screening_rows, screening_table
from ucfrec_control.commands.options import grid_options


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `screen-all` takes."""
    grid_options(parser, "control_screening")


def run(options: argparse.Namespace) -> None:
    """`ucfrec-control screen-all`."""
    rows = screening_table(options.data, options.out, options.results, options.workers)
    print(f"{format_rows(screening_rows(rows), SHOWN_SCREENING)}\n\nrows: {options.results}")
