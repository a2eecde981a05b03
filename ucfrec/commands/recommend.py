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
    draw_options,
    engine_option,
    exposures_given,
    item_options,
    limit_options,
    log_options,
    logs_given,
    memory_option,
    responder_given,
    rule_given,
    rule_options,
    spark_given,
    spark_option,
)
from ucfrec.errors import InputError, InputNote
from ucfrec.files.remote import Output, origin, uri_or_path
from ucfrec.progress import Progress, progress

if TYPE_CHECKING:
    from ucfrec.arrays import Array
    from ucfrec.recommending.histories import Histories
    from ucfrec.runs.trained_policy import TrainedPolicy


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec recommend`."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of `ucfrec train`")
    logs = log_options(parser)
    logs.nargs, logs.required = "*", False
    memory_option(parser)
    parser.add_argument("--k", type=int, default=10, help="items for each user (default: 10)")
    item_options(parser)
    parser.add_argument(
        "--candidates",
        type=Path,
        metavar="FILE",
        help="the only items to recommend: Parquet or CSV with a column item_id (default: all)",
    )
    parser.add_argument(
        "--new-session",
        action="store_true",
        help="recommend for the first step of a new session (default: the latest session of each "
        "user goes on)",
    )
    rule_options(parser)
    draw_options(parser, "FILE")
    parser.add_argument(
        "--approximate",
        action="store_true",
        help="find the items approximately, for large catalogues: needs ucfrec[faiss] and a rule "
        "without a temperature; says the recall (default: exactly)",
    )
    parser.add_argument(
        "--out",
        type=uri_or_path(Output, Path),
        help="Parquet file (with --engine spark: folder) to write",
    )
    parser.add_argument(
        "--stream",
        action="store_true",
        help="instead of LOGS and --out: read requests from stdin, JSON on each line, and write "
        "answers to stdout (docs/serving.md)",
    )
    engine_option(
        parser,
        "spark",
        more_help="; spark: with LOGS, Spark's workers each recommend to some of the users and "
        "write the parts of a folder --out",
    )
    spark_option(parser)
    limit_options(parser)


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
        from ucfrec.acting.item_index import ItemIndex

        index = ItemIndex(trained.item_scorer(rule), trained.name)
    with progress(None, "recommend", "users") as bar:
        frames = recommend(
            trained,
            _counted(histories_of_files(trained, files, mapping, options.memory_limit), bar),
            options.k,
            rule=rule,
            filter_seen=not options.keep_seen,
            candidates=_candidates_given(options, trained),
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


def _candidates_given(options: argparse.Namespace, trained: "TrainedPolicy") -> "Array | None":
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

    if options.logs or options.out:
        raise InputError("--stream reads stdin and writes stdout; leave LOGS and --out out")
    if options.engine == "spark" or options.spark_master:
        raise InputError("--stream answers in this process; leave --engine spark out")
    if options.approximate:
        raise InputError("--stream finds items exactly; leave --approximate out")
    if options.new_session:
        raise InputError("with --stream, each line says new_session; leave --new-session out")
    if options.candidates is not None:
        raise InputError("with --stream, each line has its candidates; leave --candidates out")
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


def _counted(batches: "Iterator[Histories]", bar: Progress) -> "Iterator[Histories]":
    for batch in batches:
        yield batch
        bar.update(len(batch.users))
