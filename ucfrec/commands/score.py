"""`ucfrec score`: write a policy's probability of every logged choice."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import (
    log_options,
    logs_given,
    memory_option,
    rule_given,
    rule_options,
    spark_given,
    spark_option,
)
from ucfrec.files.remote import Output, origin, uri_or_path

if TYPE_CHECKING:
    from ucfrec.runs.trained_policy import TrainedPolicy


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec score`."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of `ucfrec train`")
    log_options(parser)
    memory_option(parser)
    rule_options(parser)
    parser.add_argument(
        "--out",
        type=uri_or_path(Output, Path),
        required=True,
        help="Parquet file (with --engine spark: folder) to write",
    )
    parser.add_argument(
        "--engine",
        choices=("torch", "spark"),
        default="torch",
        help="what computes the probabilities: this process, or Spark's workers, each for some of "
        "the users, which write the parts of a folder --out (default: torch)",
    )
    spark_option(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec score`: write the probabilities as Parquet.

    Raises:
        InputError: the run or the logs cannot be used.
    """
    from ucfrec.files.parquet import write_frames
    from ucfrec.logs.summary import format_report
    from ucfrec.off_policy.score import about_scores, logged_sessions, score
    from ucfrec.runs.trained_policy import TrainedPolicy

    trained = TrainedPolicy.load(options.run, options.checkpoint)
    if (master := spark_given(options)) is not None:
        _score_with_spark(options, trained, master)
        return
    files, mapping = logs_given(options, trained)
    limit = options.memory_limit
    with logged_sessions(options.run, trained, files, mapping, memory_limit=limit) as logged:
        print(format_report(logged.report))
        rule = rule_given(options, trained)
        frames = score(trained, logged, rule)
        rows = write_frames(options.out, frames, about_scores(trained, rule))
    print(f"\n{origin(options.out)}: {rows:,} rows")


def _score_with_spark(options: argparse.Namespace, trained: "TrainedPolicy", master: str) -> None:
    from ucfrec.files.atomic import atomic_folder
    from ucfrec.logs.spark_users import by_users
    from ucfrec.off_policy.spark import ScorePart, log_to_score, number_sessions
    from ucfrec.runs.on_workers import RunOnWorkers

    run, limit = RunOnWorkers.of(trained, options.checkpoint), options.memory_limit
    given = log_to_score(trained, *logs_given(options, trained))
    with atomic_folder(options.out) as folder:
        part = ScorePart(run, folder.absolute(), limit, rule_given(options, trained))
        sessions = by_users(given, folder.parent, master, part)
        number_sessions(folder, sessions)
    print(f"{origin(options.out)}: {sum(sessions):,} sessions")
