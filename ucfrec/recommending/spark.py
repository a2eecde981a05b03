"""Recommend next items to the users of a log with Apache Spark, for users of any number."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.store import LONGEST_HISTORY
from ucfrec.files.atomic import atomic_folder
from ucfrec.files.parquet import part_name, write_frames
from ucfrec.logs.histories import read_histories
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.spark import map_users
from ucfrec.recommending.exposures import exposures_written
from ucfrec.recommending.histories import session_by
from ucfrec.recommending.recommend import decide
from ucfrec.runs.later_logs import columns_used, reward_of
from ucfrec.runs.trained_policy import RunOnWorkers, TrainedPolicy


def recommend_with_spark(
    trained: TrainedPolicy,
    files: Sequence[Path],
    mapping: LogMapping,
    out: Path,
    master: str,
    k: int = 10,
    *,
    filter_seen: bool = True,
    at: str | float | None = None,
    exposures: Path | None = None,
    checkpoint: str = "best",
    rule: DecisionRule | None = None,
    memory_limit: str = "2GB",
    **how: Any,
) -> int:
    """Write the `k` best next items of every user of logs, as `decide` finds them; returns their
    number. InputError if an argument or the logs cannot be used, or Spark is missing or fails.

    Args:
        files: logs, which every worker sees, as the run folder and `out`.
        mapping: of the logs' columns; what it leaves open is as in the training logs.
        out: folder for the recommendations, Parquet parts with users in sorted order.
        master: Spark's master, e.g. "local[*]" or "spark://host:7077".
        exposures: folder for what was shown; None for none.
        checkpoint: with which `trained` was loaded.
        memory_limit: of a worker while it reads its rows.
        filter_seen, at, how: as of `decide`; `how` are `skip_unknown`, `new_session` and `seed`.
    """
    how |= {"k": k, "rule": rule or trained.rule, "filter_seen": filter_seen, "at": at}
    recommended: Any = partial(decide, **how)
    recommended(trained, ())  # checks the arguments
    columns = columns_used(trained, mapping)
    reward, by = reward_of(trained), session_by(trained)
    with ExitStack() as stack:
        folders = [out] if exposures is None else [out, exposures]
        parts = [stack.enter_context(atomic_folder(folder)).absolute() for folder in folders]
        run = RunOnWorkers(trained.folder.absolute(), checkpoint, trained.fingerprint)
        work = partial(_recommend_part, run, parts, memory_limit, recommended)
        return sum(map_users(files, columns, reward, by, parts[0].parent, master, work))


def _recommend_part(
    run: RunOnWorkers,
    folders: Sequence[Path],
    memory_limit: str,
    recommended: Any,
    part: int,
    rows: Path,
    mapping: LogMapping,
) -> int:
    """Write the files of a part; returns the number of recommended items. A worker calls it
    (`ucfrec.logs.spark.Work`)."""
    trained, (out, *exposures) = run.load(), (folder / part_name(part) for folder in folders)
    by, duplicates = session_by(trained), trained.record.data.duplicates
    histories = read_histories(
        [rows], mapping, "reward", LONGEST_HISTORY, memory_limit, by, duplicates
    )
    decisions = recommended(trained, histories)
    frames: Iterator[pd.DataFrame] = (frame for frame, _ in decisions)
    with ExitStack() as stack:
        for path in exposures:
            how = recommended.keywords
            written = exposures_written(
                path,
                trained,
                how["rule"].hash,
                decisions,
                excludes_seen=how["filter_seen"],
                at=how["at"],
            )
            frames = stack.enter_context(written)
        return write_frames(out, frames)
