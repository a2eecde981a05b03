"""`ucfrec join`: exposures and the feedback that they got, as a log."""

import argparse

from ucfrec.commands.options import (
    INPUT,
    OUTPUT,
    log_options,
    logs_given,
    memory_option,
    option,
    read_duration,
)
from ucfrec.files.remote import origin


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec join`."""
    text = "file, folder or quoted glob that serve or recommend --exposures wrote"
    option(parser, "exposures", INPUT, text, "EXPOSURES")
    log_options(parser, "FEEDBACK")
    text = "longest time from exposure to feedback: 90s, 30m, 2h, 1d"
    option(parser, "--within", str, text, "TIME", required=True)
    option(parser, "--out", OUTPUT, "Parquet log to write", required=True)
    memory_option(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec join` and print what was matched.

    Raises:
        InputError: a file cannot be used, or --within is not a duration.
    """
    from ucfrec.logs.join import join_feedback

    within = read_duration("--within", options.within)
    files, mapping = logs_given(options)
    joined = join_feedback(
        [options.exposures], files, options.out, within, mapping, options.memory_limit
    )
    print(f"{joined}\n\n{origin(options.out)}")
