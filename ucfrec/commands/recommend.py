"""`ucfrec recommend`: the next items for users of a log."""

import argparse
from pathlib import Path

from ucfrec.commands.frames import write_frames
from ucfrec.commands.options import log_options, logs_given, target_given, target_options
from ucfrec.logs.expressions import Expression
from ucfrec.logs.prepare import read_histories
from ucfrec.recommending.recommend import LONGEST_HISTORY, Histories, recommend
from ucfrec.runs.trained_policy import RUN, TrainedPolicy


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `recommend` takes."""
    parser.add_argument("run", type=Path, metavar="RUN")
    log_options(parser)
    parser.add_argument("--k", type=int, default=10, help="items a user (10)")
    parser.add_argument("--keep-seen", action="store_true", help="seen items may come again")
    parser.add_argument(
        "--skip-unknown", action="store_true", help="ignore rows of items the run never saw"
    )
    target_options(parser)
    parser.add_argument("--out", type=Path, required=True, help="Parquet file")


def run(options: argparse.Namespace) -> None:
    """`ucfrec recommend`."""
    files, mapping = logs_given(options)
    trained = TrainedPolicy.load(options.run, options.checkpoint)
    reward = Expression(trained.record["reward"], str(options.run / RUN))
    read = read_histories(files, mapping, reward, LONGEST_HISTORY)
    frames = recommend(
        trained,
        map(Histories.from_batch, read),
        options.k,
        target_return=target_given(options, trained),
        filter_seen=not options.keep_seen,
        skip_unknown=options.skip_unknown,
    )
    print(f"{options.out}: {write_frames(options.out, frames):,} rows")
