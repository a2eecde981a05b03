"""Recommend next items to the users of a log with Apache Spark, for users of any number."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.earlier import LONGEST_HISTORY
from ucfrec.files.parquet import part_name, write_frames
from ucfrec.logs.histories import read_histories
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.spark_users import GivenLog
from ucfrec.recommending.exposures import exposures_written
from ucfrec.recommending.histories import Histories, columns_used, reward_of, session_by
from ucfrec.recommending.recommend import recommend
from ucfrec.runs.on_workers import RunOnWorkers
from ucfrec.runs.trained_policy import TrainedPolicy


@dataclass(frozen=True)
class RecommendPart:
    """Recommends to the users of a part, see `ucfrec.logs.spark_users.Work`."""

    run: RunOnWorkers
    out: Path
    """Folder for the parts of the recommendations, as of `recommend`."""
    exposures: Path | None
    """Folder for the parts of the exposures; None for none."""
    memory_limit: str
    """Of a worker while it reads its rows."""
    rule: DecisionRule
    k: int
    filter_seen: bool
    skip_unknown: bool
    seed: int

    def __call__(self, part: int, rows: Path, mapping: LogMapping) -> int:
        """Write the files of a part; returns the number of recommended items."""
        trained, name = self.run.load(), part_name(part)
        histories = read_histories(
            [rows],
            mapping,
            "reward",
            LONGEST_HISTORY,
            self.memory_limit,
            session_by(trained),
            trained.record.data.duplicates,
        )
        frames = recommend(
            trained,
            map(Histories.from_batch, histories),
            self.k,
            rule=self.rule,
            filter_seen=self.filter_seen,
            skip_unknown=self.skip_unknown,
            seed=self.seed,
        )
        with ExitStack() as stack:
            if self.exposures is not None:
                given = self.exposures / name, trained, self.rule.hash, frames
                frames = stack.enter_context(exposures_written(*given))
            return write_frames(self.out / name, frames)


def log_of_histories(
    trained: TrainedPolicy, files: Sequence[Path], mapping: LogMapping
) -> GivenLog:
    """Logs as `histories_of_files` reads them, for `ucfrec.logs.spark_users.by_users`."""
    columns = columns_used(trained, mapping)
    return GivenLog(files, columns, reward_of(trained), session_by(trained))
