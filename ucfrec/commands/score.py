"""`ucfrec score`: write a policy's probability of every logged choice."""

import argparse
from pathlib import Path

from ucfrec.commands.options import (
    log_options,
    logs_given,
    memory_option,
    rule_given,
    rule_options,
)
from ucfrec.files.remote import Output, origin, uri_or_path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec score`."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of `ucfrec train`")
    log_options(parser)
    memory_option(parser)
    rule_options(parser)
    parser.add_argument(
        "--out", type=uri_or_path(Output, Path), required=True, help="Parquet file to write"
    )


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec score`: write the probabilities as Parquet.

    Raises:
        InputError: the run or the logs cannot be used.
    """
    from ucfrec.commands.frames import write_frames
    from ucfrec.logs.summary import format_report
    from ucfrec.off_policy.score import logged_sessions, score
    from ucfrec.runs.trained_policy import TrainedPolicy

    trained = TrainedPolicy.load(options.run, options.checkpoint)
    files, mapping = logs_given(options, trained)
    limit = options.memory_limit
    with logged_sessions(options.run, trained, files, mapping, memory_limit=limit) as logged:
        print(format_report(logged.report))
        rows = write_frames(options.out, score(trained, logged, rule_given(options, trained)))
    print(f"\n{origin(options.out)}: {rows:,} rows")
