"""Users' histories, read in the same way as the training logs of a run."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from ucfrec import schema
from ucfrec.arrays import Array
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.store import LONGEST_HISTORY
from ucfrec.errors import InputError
from ucfrec.logs.expressions import computes_with_reward
from ucfrec.logs.histories import Histories, frame_histories, read_histories
from ucfrec.logs.mapping import LogMapping
from ucfrec.runs.later_logs import columns_used, reward_of
from ucfrec.runs.trained_policy import TrainedPolicy


def histories_of_files(
    trained: TrainedPolicy,
    files: Sequence[str | Path],
    mapping: LogMapping,
    memory_limit: str = "2GB",
) -> Iterator[Histories]:
    """Read histories from log files, folders and globs in batches of users, in sorted order.

    Args:
        trained: policy whose reward expression, session rule and observations apply.
        mapping: names of the columns; what it leaves open is as in the training log.
        memory_limit: of the process, such as "2GB"; rows spill to disk.

    Raises:
        InputError: a file or a column is missing, or has values that cannot be used.
    """
    return read_histories(
        files,
        columns_used(trained, mapping),
        reward_of(trained),
        LONGEST_HISTORY,
        memory_limit,
        session_by=session_by(trained),
        duplicates=trained.record.data.duplicates,
    )


def histories_of_frame(
    trained: TrainedPolicy,
    frame: pd.DataFrame,
    mapping: LogMapping,
    stored: bool = False,
) -> Iterator[Histories]:
    """`histories_of_files` of a frame with one row per interaction.

    Rewards are the frame's column `reward`, unless the run's reward expression computes with a
    column of that name; otherwise that expression over the frame's columns.

    Args:
        stored: whether the frame is of a store, whose column `reward` is what was computed.
    """
    columns = {str(name) for name in getattr(frame, "columns", ())}
    computed = not stored and computes_with_reward(trained.record.reward)
    has_rewards = not computed and schema.REWARD in columns
    return frame_histories(
        frame,
        columns_used(trained, mapping),
        schema.REWARD if has_rewards else reward_of(trained),
        LONGEST_HISTORY,
        session_by=session_by(trained),
        duplicates=trained.record.data.duplicates,
    )


def select_users(batches: Iterable[Histories], users: Array) -> Iterator[Histories]:
    """The histories of the named users only, in the order of `batches`; InputError if one of them
    has no rows, once all are read."""
    lookup = IdLookup(pd.unique(users))
    has_rows = np.zeros(len(lookup), dtype=bool)
    for batch in batches:
        numbers = lookup.numbers(batch.users)
        has_rows[numbers[numbers >= 0]] = True
        if (numbers >= 0).any():
            yield batch.of_users(np.flatnonzero(numbers >= 0))
    if not has_rows.all():
        missing = lookup.ids[~has_rows]
        raise InputError(
            f"{len(missing):,} of {len(lookup):,} users have no rows in the histories, such as "
            f"{missing[0]}; leave them out, or add rows"
        )


def session_by(trained: TrainedPolicy) -> str:
    """How `read_histories` splits the sessions of the run's logs."""
    by_id = trained.record.session_by == schema.SESSION_ID
    return schema.SESSION_ID if by_id else "user"
