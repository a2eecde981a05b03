"""Kuaishou logs as the public experiments use them: time windows, and sessions by an exit rule."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import gettempdir

import numpy as np
import pyarrow as pa

from ucfrec.arrays import IntArray
from ucfrec.errors import InputError
from ucfrec.logs.engine import engine
from ucfrec.logs.tables import glob_pattern, quote
from ucfrec.schema import SESSION_ID
from ucfrec_simulators.kuai.environment import ExitRule, KuaiEnv

USER, VIDEO = "user_id", "video_id"


def window(files: Sequence[Path], time: str, where: str) -> pa.Table:
    """Rows of a window of the logs, ordered by user and time, without repeated (user, video, time).
    InputError if no row is in the window.

    Args:
        files: Parquet or CSV files with the same columns.
        where: SQL condition that selects the window.
    """
    names = ", ".join(quote(glob_pattern(file)) for file in files)
    reader = "read_parquet" if files[0].suffix == ".parquet" else "read_csv"
    key = f"{USER}, {VIDEO}, {time}"
    with engine(files, Path(gettempdir())) as connection:
        rows = connection.sql(
            f"SELECT * FROM {reader}([{names}], hive_partitioning = false) WHERE {where} "
            f"QUALIFY row_number() OVER (PARTITION BY {key}) = 1 ORDER BY {USER}, {time}, {VIDEO}"
        ).to_arrow_table()
    if not rows.num_rows:
        raise InputError(f"{files[0]}: no row satisfies {where}; give the official logs")
    return rows


def cut_by_exit(rows: pa.Table, tags: Mapping[int, Sequence[int]], exit_rule: ExitRule) -> pa.Table:
    """Add a `session_id` to rows of `window`: a session ends where the user would have left; videos
    without tags may be missing in `tags`."""
    videos, numbers = np.unique(np.asarray(rows[VIDEO]), return_inverse=True)
    video_tags: list[Sequence[int]] = [tags.get(int(video), ()) for video in videos]
    sessions = sessions_by_exit(np.asarray(rows[USER]), numbers, video_tags, exit_rule)
    return rows.append_column(SESSION_ID, pa.array(sessions))


def part_of(rows: pa.Table, part: int, parts: int) -> pa.Table:
    """The sessions, numbered from 0, of one of `parts` parts of a log (from 0), to which they are
    dealt out at random."""
    sessions = np.asarray(rows[SESSION_ID])
    dealt = np.random.default_rng(0).integers(parts, size=sessions.max() + 1)
    return rows.filter(pa.array(dealt[sessions] == part))


def sessions_by_exit(
    users: IntArray, items: IntArray, tags: Sequence[Sequence[int]], exit_rule: ExitRule
) -> IntArray:
    """Replay logged items through an exit rule, as the public code (EasyRL4Rec) makes its episodes.

    The row at which the rule ends a session, or at which the session has its maximum length, is the
    session's last; the user's next row starts a new session. All users are replayed in parallel,
    one row each per step.

    Args:
        users: (N,) user of each row; rows of a user are contiguous and in order of time.
        items: (N,) index into `tags` of the item shown.
        tags: tags of each item; an item without any gets the tag −1.

    Returns:
        (N,) session of each row, numbered from 0 in the order of the rows.
    """
    _, starts, lengths = np.unique(users, return_index=True, return_counts=True)
    environment = KuaiEnv(len(starts), np.zeros((1, len(tags)), dtype=np.float32), tags, exit_rule)
    environment.reset(seed=0)
    last = np.zeros(len(users), dtype=np.bool_)
    for step in range(lengths.max()):
        # Users without further rows repeat their last one, whose session is ended below anyway.
        rows = starts + np.minimum(step, lengths - 1)
        _, _, terminated, truncated, _ = environment.step(items[rows])
        active = step < lengths
        last[rows[active]] = (terminated | truncated)[active]
    last[starts + lengths - 1] = True
    return np.concatenate([[0], np.cumsum(last)[:-1]])
