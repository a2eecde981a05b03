"""The probability that a policy gives to each choice of logs of any size, with Apache Spark."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.files.atomic import atomic_file
from ucfrec.files.parquet import part_name, write_frames
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.spark_users import GivenLog
from ucfrec.off_policy.score import (
    SESSION,
    about_scores,
    as_trained,
    prepared_sessions,
    require_items,
    score,
)
from ucfrec.runs.on_workers import RunOnWorkers
from ucfrec.runs.trained_policy import ITEMS, TrainedPolicy


@dataclass(frozen=True)
class ScorePart:
    """Scores the sessions of a part, see `ucfrec.logs.spark_users.Work`."""

    run: RunOnWorkers
    out: Path
    """Folder for the parts, with sessions numbered from 0 in each."""
    memory_limit: str
    """Of a worker while it reads its rows."""
    rule: DecisionRule

    def __call__(self, part: int, rows: Path, mapping: LogMapping) -> int:
        """Write the file of a part; returns its number of sessions."""
        trained = self.run.load()
        _, options = as_trained(trained, mapping, self.memory_limit)
        options = replace(options, reward=schema.REWARD)
        with prepared_sessions(trained, [rows], mapping, options) as logged:
            frames = score(trained, logged, self.rule)
            write_frames(self.out / part_name(part), frames, about_scores(trained, self.rule))
            return logged.store.n_episodes


def log_to_score(trained: TrainedPolicy, files: Sequence[Path], mapping: LogMapping) -> GivenLog:
    """Logs as `logged_sessions` reads them, for `by_users`.

    Raises:
        InputError: the policy's actions are vectors.
    """
    require_items(trained)
    mapping, options = as_trained(trained, mapping)
    assert options.reward is not None
    return GivenLog(files, mapping, options.reward, options.session_by, trained.folder / ITEMS)


def number_sessions(folder: Path, sessions: Sequence[int]) -> None:
    """Number the sessions of all parts in a row, as those of one file are.

    Args:
        folder: of the parts.
        sessions: number of each part's sessions, in the order of the names.
    """
    before = 0
    for file, count in zip(sorted(folder.iterdir()), sessions, strict=True):
        if before:
            _shift(file, before)
        before += count


def _shift(file: Path, by: int) -> None:
    with atomic_file(file) as scratch, pq.ParquetFile(file) as source:
        place = source.schema_arrow.get_field_index(SESSION)
        with pq.ParquetWriter(scratch, source.schema_arrow) as writer:
            for batch in source.iter_batches():
                shifted = pc.add(batch.column(place), pa.scalar(by, pa.int64()))
                writer.write_batch(batch.set_column(place, SESSION, shifted))
