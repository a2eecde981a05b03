"""Recommend next items to the users of a log with Apache Spark, for users of any number."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pandas as pd

from ucfrec.acting.decision import DecisionRule
from ucfrec.episodes.store import LONGEST_HISTORY
from ucfrec.files.atomic import atomic_folder
from ucfrec.files.parquet import part_name, write_frames
from ucfrec.logs.histories import Histories, read_histories
from ucfrec.logs.mapping import LogMapping
from ucfrec.logs.spark import UserLog, map_users
from ucfrec.recommending.exposures import exposures_written
from ucfrec.recommending.histories import session_by
from ucfrec.recommending.recommend import recommend
from ucfrec.runs.later_logs import columns_used, reward_of
from ucfrec.runs.trained_policy import RunOnWorkers, TrainedPolicy
from ucfrec.settings import require_whole


def recommend_with_spark(
    trained: TrainedPolicy,
    files: Sequence[Path],
    mapping: LogMapping,
    out: Path,
    master: str,
    k: int = 10,
    *,
    exposures: Path | None = None,
    checkpoint: str = "best",
    rule: DecisionRule | None = None,
    filter_seen: bool = True,
    skip_unknown: bool = False,
    new_session: bool = False,
    at: str | float | None = None,
    seed: int = 0,
    memory_limit: str = "2GB",
) -> int:
    """Write the `k` best next items of every user of logs, as `recommend` finds them; returns their
    number.

    Args:
        files: logs, which every worker sees, as the run folder and `out`.
        mapping: of the logs' columns; what it leaves open is as in the training logs.
        out: folder for the recommendations, Parquet parts with users in sorted order.
        master: Spark's master, e.g. "local[*]" or "spark://host:7077".
        exposures: folder for what was shown; None for none.
        checkpoint: with which `trained` was loaded.
        memory_limit: of a worker while it reads its rows.

    Raises:
        InputError: an argument or the logs cannot be used, or Spark is missing or fails.
    """
    rule = rule or trained.rule
    trained.item_scorer(rule)
    require_whole("k", k)
    columns = columns_used(trained, mapping)
    log = UserLog(files, columns, reward_of(trained), session_by(trained))
    with ExitStack() as stack:
        folders = [out] if exposures is None else [out, exposures]
        parts = [stack.enter_context(atomic_folder(folder)).absolute() for folder in folders]
        recommended = partial(
            recommend,
            k=k,
            rule=rule,
            filter_seen=filter_seen,
            skip_unknown=skip_unknown,
            new_session=new_session,
            at=at,
            seed=seed,
        )
        exposed = None if exposures is None else parts[1]
        run = RunOnWorkers(trained.folder.absolute(), checkpoint, trained.fingerprint)
        part = _RecommendPart(run, parts[0], exposed, memory_limit, rule.hash, recommended)
        return sum(map_users(log, parts[0].parent, master, part))


@dataclass(frozen=True)
class _RecommendPart:
    """Recommends to the users of a part, see `ucfrec.logs.spark.Work`."""

    run: RunOnWorkers
    out: Path
    exposures: Path | None
    memory_limit: str
    rule: str
    """Hash of the decision rule."""
    recommend: Callable[[TrainedPolicy, Iterable[Histories]], Iterator[pd.DataFrame]]

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
        frames = self.recommend(trained, histories)
        with ExitStack() as stack:
            if self.exposures is not None:
                arguments = self.exposures / name, trained, self.rule, frames
                frames = stack.enter_context(exposures_written(*arguments))
            return write_frames(self.out / name, frames)
