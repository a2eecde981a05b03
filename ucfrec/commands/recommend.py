"""`ucfrec recommend`: recommend the next items to the users of a log or of a stream."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from ucfrec.errors import InputError
from ucfrec.files.remote import Output, origin, uri_or_path
from ucfrec.progress import Progress, progress

if TYPE_CHECKING:
    from ucfrec.recommending.histories import Histories
    from ucfrec.runs.trained_policy import TrainedPolicy


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec recommend`."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of `ucfrec train`")
    logs = log_options(parser)
    memory_option(parser)
    parser.add_argument("--k", type=int, default=10, help="items for each user (default: 10)")
    item_options(parser)
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
    out = parser.add_argument(
        "--out",
        type=uri_or_path(Output, Path),
        required=True,
        help="Parquet file (with --engine spark: folder) to write",
    )
    parser.add_argument(
        "--stream",
        action=_Stream,
        instead_of=(logs, out),
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


class _Stream(argparse.Action):
    """A flag that makes other arguments optional."""

    def __init__(self, instead_of: tuple[argparse.Action, ...], **named: Any) -> None:
        super().__init__(nargs=0, default=False, **named)
        self._instead_of = instead_of

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, True)
        for action in self._instead_of:
            action.required = False


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec recommend`: write the recommendations as Parquet, or answer a stream.

    Raises:
        InputError: the run or the logs cannot be used.
    """
    if options.stream:
        _answer_stream(options)
        return
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


def _recommend_with_spark(
    options: argparse.Namespace, trained: "TrainedPolicy", master: str
) -> None:
    from ucfrec.recommending.spark import recommend_with_spark

    if options.approximate:
        raise InputError("--engine spark finds items exactly; leave --approximate out")
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
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    responder = responder_given(options, trained)
    # Unbuffered, so that a request is answered without waiting for the next ones.
    with (
        exposures_given(options, trained) as exposures,
        open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as source,
    ):
        counts = answer_stream(responder, source, sys.stdout.buffer, exposures=exposures)
    responder.close()
    print(
        f"ucfrec recommend: {counts.answers:,} answers, {counts.errors:,} errors", file=sys.stderr
    )


def _counted(batches: "Iterator[Histories]", bar: Progress) -> "Iterator[Histories]":
    for batch in batches:
        yield batch
        bar.update(len(batch.users))
