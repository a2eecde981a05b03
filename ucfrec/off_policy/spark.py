"""The probability that a policy gives to each choice of logs of any size, with Apache Spark."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.files.atomic import atomic_file, atomic_folder
from ucfrec.files.parquet import part_name, write_frames
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.spark import UserLog, map_users
from ucfrec.off_policy.score import (
    SESSION,
    about_scores,
    prepare_sessions,
    require_items,
    score,
    training_options,
)
from ucfrec.runs.on_workers import RunOnWorkers
from ucfrec.runs.trained_policy import ITEMS, TrainedPolicy


def score_with_spark(
    trained: TrainedPolicy,
    files: Sequence[Path],
    mapping: LogMapping,
    out: Path,
    master: str,
    *,
    checkpoint: str = "best",
    rule: DecisionRule | None = None,
    filter_seen: bool = False,
    memory_limit: str = "2GB",
) -> int:
    """Write the probability of every choice of logs, as `score` finds it.

    Args:
        files: logs, which every worker sees, as the run folder and `out`.
        mapping: of the logs' columns; what it leaves open is as in the training logs.
        out: folder for the scores, Parquet parts with sessions numbered throughout.
        master: Spark's master, e.g. "local[*]" or "spark://host:7077".
        checkpoint: with which `trained` was loaded.
        filter_seen: exclude items that the user was shown before a step.
        memory_limit: of a worker while it reads its rows.

    Returns:
        The number of sessions.

    Raises:
        InputError: the policy's actions are vectors, the logs cannot be used, or Spark is missing
            or fails.
    """
    require_items(trained)
    columns, options = training_options(trained, mapping)
    assert options.reward is not None
    log = UserLog(files, columns, options.reward, options.session_by, trained.folder / ITEMS)
    with atomic_folder(out) as folder:
        run, rule = RunOnWorkers.of(trained, checkpoint), rule or trained.rule
        part = _ScorePart(run, folder.absolute(), memory_limit, rule, filter_seen)
        sessions = map_users(log, folder.parent, master, part)
        number_sessions(folder, sessions)
    return sum(sessions)


@dataclass(frozen=True)
class _ScorePart:
    """Scores the sessions of a part, see `ucfrec.logs.spark.Work`."""

    run: RunOnWorkers
    out: Path
    """Folder for the parts, with sessions numbered from 0 in each."""
    memory_limit: str
    """Of a worker while it reads its rows."""
    rule: DecisionRule
    filter_seen: bool

    def __call__(self, part: int, rows: Path, mapping: LogMapping) -> int:
        """Write the file of a part; returns its number of sessions."""
        trained = self.run.load()
        _, options = training_options(trained, mapping, self.memory_limit)
        options = replace(options, reward=schema.REWARD)
        with prepare_sessions(trained, [rows], mapping, options) as logged:
            frames = score(trained, logged, self.rule, self.filter_seen)
            write_frames(self.out / part_name(part), frames, about_scores(trained, self.rule))
            return logged.store.n_episodes


def number_sessions(folder: Path, sessions: Sequence[int]) -> None:
    """Number the sessions of all parts in a row, as those of one file are.

    Args:
        folder: of the parts.
        sessions: number of each part's sessions, in the order of the names.
    """
    first = 0
    for file, count in zip(sorted(folder.iterdir()), sessions, strict=True):
        with atomic_file(file) as scratch, pq.ParquetFile(file) as source:
            place = source.schema_arrow.get_field_index(SESSION)
            with pq.ParquetWriter(scratch, source.schema_arrow) as writer:
                for batch in source.iter_batches():
                    numbers = pc.add(batch.column(place), pa.scalar(first, pa.int64()))
                    writer.write_batch(batch.set_column(place, SESSION, numbers))
        first += count
