"""`ucfrec prepare`: turn logs into an episode store."""

import argparse

from ucfrec.commands.options import (
    OUTPUT,
    log_options,
    logs_given,
    option,
    spark_given,
    spark_option,
)
from ucfrec.errors import InputError
from ucfrec.files.remote import origin


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec prepare`."""
    reading = log_options(parser)
    text = "new folder for the store; also at s3://, gs://, hdfs://, …"
    option(parser, "--out", OUTPUT, text, "STORE")
    option(
        parser,
        "--reward",
        str,
        "scalar SQL expression over the log's columns, e.g. is_click (default: of the "
        "dataset or --mapping, else the column reward)",
        "SQL",
    )
    option(
        parser,
        "--session-by",
        ["gap", "user", "session_id"],
        "start a new session after a pause, once per user, or with a new session_id "
        "(default: of the dataset or --mapping, else session_id if the log has it, else gap)",
    )
    option(
        parser,
        "--gap-minutes",
        float,
        "with --session-by gap: a longer pause of the user ends the session (default: 30)",
        "MINUTES",
    )
    option(
        parser,
        "--split",
        str,
        "shares of the rows in order of time; or two ISO times (UTC) at which validation and "
        "test begin (default: 0.8,0.1,0.1)",
        "TRAIN,VALIDATION,TEST",
    )
    option(parser, "--validate", False, "check the logs without writing a store")
    option(
        reading,
        "--duplicates",
        ["highest", "lowest", "first", "last"],
        "of rows with the same user, item and time, keep that with the highest or lowest "
        "reward, or the first or last in the files (default: highest)",
    )
    text = "exclude and count sessions of more than N rows, as of bots (default: none)"
    option(reading, "--max-session", int, text, "N")
    engine = parser.add_argument_group("engine and memory")
    option(
        engine,
        "--memory-limit",
        str,
        "memory of the whole command, from 800MB on; beyond it rows spill to a scratch folder "
        "beside the store, to at most 90%% of the free disk (default: 2GB)",
        "SIZE",
    )
    option(
        engine,
        "--engine",
        ["duckdb", "spark"],
        "what reads and sorts the rows: DuckDB on this machine, or Spark, for logs that "
        "outgrow it; the store is the same (default: duckdb)",
    )
    spark_option(engine)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec prepare` and print what was read, dropped and kept.

    Raises:
        InputError: the logs cannot be used, options do not go together, or neither --out nor
            --validate is given.
    """
    from ucfrec.logs.expressions import Expression
    from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare, validate
    from ucfrec.logs.summary import format_report

    files, mapping = logs_given(options)
    by = options.session_by or mapping.session_by or "gap"
    if options.gap_minutes is not None and by != "gap":
        raise InputError(f"--gap-minutes needs --session-by gap, not {by}; leave one of them out")
    fields = {
        "reward": options.reward and Expression(options.reward, "--reward"),
        "session_by": options.session_by,
        "dataset": options.dataset or "generic",
        "gap_minutes": options.gap_minutes,
        "duplicates": options.duplicates,
        "max_session": options.max_session,
        "memory_limit": options.memory_limit,
        "engine": options.engine,
        "spark_master": spark_given(options),
        "split": options.split and parse_split(options.split),
    }
    how = PrepareOptions(**{name: value for name, value in fields.items() if value is not None})
    if options.validate:
        print(format_report(validate(files, mapping, how)))
        print("\nnothing was written; next: the same command with --out STORE, not --validate")
        return
    if options.out is None:
        raise InputError("no store is named; add --out STORE, or --validate to only check the logs")
    print(format_report(prepare(files, mapping, options.out, how)))
    store = origin(options.out)
    print(
        f"\nstore: {store}; policies learn from its train split, later rows validate and test them"
        f"\nnext: ucfrec train {store} --out RUN"
    )
