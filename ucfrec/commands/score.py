"""`ucfrec score`: write a policy's probability of every logged choice."""

import argparse

from ucfrec.commands.options import (
    OUTPUT,
    filter_seen_option,
    log_options,
    logs_given,
    memory_option,
    option,
    rule_given,
    rule_options,
    run_option,
    spark_given,
    spark_option,
)
from ucfrec.files.remote import origin


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec score`."""
    run_option(parser)
    memory_option(log_options(parser))
    rule_options(parser)
    filter_seen_option(parser)
    text = "Parquet file (with --engine spark: folder) to write"
    option(parser, "--out", OUTPUT, text, required=True)
    option(
        parser,
        "--engine",
        ["torch", "spark"],
        "what computes the probabilities: this process; or Spark's workers, each for some of "
        "the users, which write the parts of a folder --out (default: torch)",
        default="torch",
    )
    spark_option(parser)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec score`: write the probabilities as Parquet.

    Raises:
        InputError: the run or the logs cannot be used.
    """
    from ucfrec.files.parquet import write_frames
    from ucfrec.logs.summary import format_report
    from ucfrec.off_policy.score import UNKNOWN_ITEMS, about_scores, read_logged_sessions, score
    from ucfrec.runs.trained_policy import TrainedPolicy

    trained = TrainedPolicy.load(options.run, options.checkpoint)
    if (master := spark_given(options)) is not None:
        from ucfrec.off_policy.scored import score_with_spark

        sessions = score_with_spark(
            trained,
            *logs_given(options, trained),
            options.out,
            master,
            checkpoint=options.checkpoint,
            rule=rule_given(options, trained),
            filter_seen=options.filter_seen,
            memory_limit=options.memory_limit,
        )
        print(f"{origin(options.out)}: {sessions:,} sessions")
        return
    files, mapping = logs_given(options, trained)
    limit = options.memory_limit
    with read_logged_sessions(trained, files, mapping, memory_limit=limit) as logged:
        print(format_report(logged.report))
        rule = rule_given(options, trained)
        frames = score(trained, logged, rule, options.filter_seen)
        unknown = {UNKNOWN_ITEMS: str(logged.report["dropped"].get("unknown_item", 0))}
        rows = write_frames(options.out, frames, about_scores(trained, rule) | unknown)
    print(f"\n{origin(options.out)}: {rows:,} rows")
