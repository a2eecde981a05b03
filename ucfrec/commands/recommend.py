"""`ucfrec recommend`: recommend the next items to the users of a log or of a stream."""

import argparse
import sys
import warnings
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec import schema
from ucfrec.commands.options import (
    OUTPUT,
    answer_options,
    exposures_given,
    log_options,
    logs_given,
    memory_option,
    option,
    responder_given,
    rule_given,
    rule_options,
    run_option,
    spark_given,
    spark_option,
)
from ucfrec.errors import InputError, InputNote
from ucfrec.files.remote import origin
from ucfrec.progress import Progress, progress

if TYPE_CHECKING:
    from ucfrec.arrays import Array
    from ucfrec.recommending.histories import Histories
    from ucfrec.runs.trained_policy import TrainedPolicy


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec recommend`."""
    run_option(parser)
    memory_option(log_options(parser, nargs="*"))
    answering = answer_options(parser, "FILE", "spark")
    text = "Parquet file (with --engine spark: folder) to write"
    option(parser, "--out", OUTPUT, text)
    option(
        parser,
        "--stream",
        False,
        "instead of LOGS and --out: read requests from stdin, JSON on each line, and write "
        "answers to stdout; see docs/serving.md",
    )
    option(
        parser,
        "--candidates",
        Path,
        "the only items to recommend: Parquet or CSV with a column item_id (default: all)",
        "FILE",
    )
    option(
        answering,
        "--new-session",
        False,
        "recommend for the first step of a new session (default: the latest session of each "
        "user goes on)",
    )
    rule_options(parser)
    option(
        answering,
        "--approximate",
        False,
        "find the items approximately, for large catalogues: needs ucfrec[faiss] and a rule "
        "without a temperature; says the recall (default: exactly)",
    )
    spark_option(answering)


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec recommend`: write the recommendations as Parquet, or answer a stream.

    Raises:
        InputError: the run or the logs cannot be used.
    """
    if options.stream:
        _answer_stream(options)
        return
    if not options.logs or options.out is None:
        raise InputError(
            "name LOGS after the run and the file to write with --out; or give --stream"
        )
    from ucfrec.files.parquet import write_frames
    from ucfrec.recommending.exposures import exposures_written
    from ucfrec.recommending.histories import histories_of_files
    from ucfrec.recommending.recommend import recommend
    from ucfrec.runs.trained_policy import TrainedPolicy

    trained = TrainedPolicy.load(options.run, options.checkpoint)
    if (master := spark_given(options)) is not None:
        _recommend_with_spark(options, trained, master)
        return
    files, mapping = logs_given(options, trained)
    rule, index = rule_given(options, trained), None
    if options.approximate:
        from ucfrec.recommending.recommend import ItemIndex

        index = ItemIndex(trained.item_scorer(rule), trained.name)
    with progress(None, "recommend", "users") as bar:
        frames = recommend(
            trained,
            _count_users(histories_of_files(trained, files, mapping, options.memory_limit), bar),
            options.k,
            rule=rule,
            filter_seen=not options.keep_seen,
            candidates=_read_candidates(options, trained),
            skip_unknown=options.skip_unknown,
            new_session=options.new_session,
            seed=options.seed,
            index=index,
        )
        if options.exposures is None:
            rows = write_frames(options.out, frames)
        else:
            with exposures_written(options.exposures, trained, rule.hash, frames) as written:
                rows = write_frames(options.out, written)
    print(f"{origin(options.out)}: {rows:,} rows")
    if index is not None and index.wanted:
        print(
            f"recall@{options.k} against the exact search: {index.found / index.wanted:.3f} "
            f"({index.sampled:,} users)"
        )


def _read_candidates(options: argparse.Namespace, trained: "TrainedPolicy") -> "Array | None":
    """The ids in the file of candidates that the run knows; all ids if it knows none."""
    if options.candidates is None:
        return None
    from ucfrec.reporting.samples import read_features

    table = read_features(options.candidates, text_ids=True)
    ids: Array = table.column(schema.ITEM_ID).drop_null().unique().to_numpy(zero_copy_only=False)
    known = trained.items.numbers(ids) >= 0
    if known.all() or not known.any():
        return ids
    warnings.warn(
        f"{options.candidates}: the run does not know {int((~known).sum()):,} of {len(ids):,} "
        "items, which are not recommended; prepare and train on logs with them",
        InputNote,
        stacklevel=2,
    )
    return ids[known]


def _recommend_with_spark(
    options: argparse.Namespace, trained: "TrainedPolicy", master: str
) -> None:
    from ucfrec.recommending.spark import recommend_with_spark

    if options.approximate:
        raise InputError("--engine spark finds items exactly; leave --approximate out")
    if options.candidates is not None:
        raise InputError("--engine spark recommends all items; leave --candidates out")
    rows = recommend_with_spark(
        trained,
        *logs_given(options, trained),
        options.out,
        master,
        options.k,
        exposures=options.exposures,
        checkpoint=options.checkpoint,
        rule=rule_given(options, trained),
        filter_seen=not options.keep_seen,
        skip_unknown=options.skip_unknown,
        new_session=options.new_session,
        seed=options.seed,
        memory_limit=options.memory_limit,
    )
    print(f"{origin(options.out)}: {rows:,} rows")


def _answer_stream(options: argparse.Namespace) -> None:
    from ucfrec.recommending.stream import answer_stream
    from ucfrec.runs.trained_policy import TrainedPolicy

    refusals = {
        "--stream reads stdin and writes stdout; leave LOGS and --out out": options.logs
        or options.out,
        "--stream answers in this process; leave --engine spark out": options.engine == "spark"
        or options.spark_master,
        "--stream finds items exactly; leave --approximate out": options.approximate,
        "with --stream, each line says new_session; leave --new-session out": options.new_session,
        "with --stream, each line has its candidates; leave --candidates out": options.candidates,
    }
    for message, refused in refusals.items():
        if refused:
            raise InputError(message)
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    # Unbuffered, so that a request is answered without waiting for the next ones.
    with (
        closing(responder_given(options, trained)) as responder,
        exposures_given(options, trained) as exposures,
        open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as source,
    ):
        counts = answer_stream(responder, source, sys.stdout.buffer, exposures=exposures)
    print(
        f"ucfrec recommend: {counts.answers:,} answers, {counts.errors:,} errors", file=sys.stderr
    )


def _count_users(batches: "Iterator[Histories]", bar: Progress) -> "Iterator[Histories]":
    for batch in batches:
        yield batch
        bar.update(len(batch.users))
