"""`ucfrec recommend`: recommend the next items to the users of a log."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import log_options, logs_given, rule_given, rule_options
from ucfrec.progress import Progress, progress

if TYPE_CHECKING:
    from ucfrec.recommending.histories import Histories


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec recommend`."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of `ucfrec train`")
    log_options(parser)
    parser.add_argument("--k", type=int, default=10, help="items for each user (default: 10)")
    parser.add_argument(
        "--keep-seen",
        action="store_true",
        help="also recommend items that the user has seen (default: leave them out)",
    )
    parser.add_argument(
        "--skip-unknown",
        action="store_true",
        help="ignore rows with items outside the catalogue of the run (default: an error)",
    )
    rule_options(parser)
    parser.add_argument("--out", type=Path, required=True, help="Parquet file to write")


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec recommend`: write the recommendations as Parquet.

    Raises:
        InputError: the run or the logs cannot be used.
    """
    from ucfrec.commands.frames import write_frames
    from ucfrec.recommending.histories import histories_of_files
    from ucfrec.recommending.recommend import recommend
    from ucfrec.runs.trained_policy import TrainedPolicy

    files, mapping = logs_given(options)
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    with progress(None, "recommend", "users") as bar:
        frames = recommend(
            trained,
            _counted(histories_of_files(trained, files, mapping), bar),
            options.k,
            rule=rule_given(options, trained),
            filter_seen=not options.keep_seen,
            skip_unknown=options.skip_unknown,
        )
        rows = write_frames(options.out, frames)
    print(f"{options.out}: {rows:,} rows")


def _counted(batches: "Iterator[Histories]", bar: Progress) -> "Iterator[Histories]":
    for batch in batches:
        yield batch
        bar.update(len(batch.users))
