"""`ucfrec join`: exposures and the feedback that they got, as a log."""

import argparse
from pathlib import Path

from ucfrec.commands.durations import duration_ms
from ucfrec.commands.options import log_options, logs_given, memory_option
from ucfrec.files.remote import Input, Output, origin, uri_or_path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec join`."""
    parser.add_argument(
        "exposures",
        type=uri_or_path(Input, str),
        metavar="EXPOSURES",
        help="file, folder or quoted glob that serve or recommend --exposures wrote",
    )
    log_options(parser).metavar = "FEEDBACK"
    parser.add_argument(
        "--within",
        required=True,
        metavar="TIME",
        help="longest time from exposure to feedback: 90s, 30m, 2h, 1d",
    )
    parser.add_argument(
        "--out", type=uri_or_path(Output, Path), required=True, help="Parquet log to write"
    )
    memory_option(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec join` and print what was matched.

    Raises:
        InputError: a file cannot be used, or --within is not a duration.
    """
    from ucfrec.logs.join import join_feedback

    within = duration_ms("--within", options.within)
    files, mapping = logs_given(options)
    joined = join_feedback(
        [options.exposures], files, options.out, within, mapping, options.memory_limit
    )
    print(f"{joined}\n\n{origin(options.out)}")
