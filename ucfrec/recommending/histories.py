"""Users' histories, read in the same way as the training logs of a run."""

import re
import time
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
from ucfrec.logs.mapping import EARLIEST_MS, LogMapping
from ucfrec.logs.rows import choose_rows, take_rows
from ucfrec.runs.later_logs import columns_used, reward_of
from ucfrec.runs.trained_policy import TrainedPolicy

_MOST_PLAIN_ROWS = 1_000_000
"""Rows up to which a frame is read at once, not in batches of users."""


def histories_of_files(
    trained: TrainedPolicy,
    files: Sequence[str | Path],
    mapping: LogMapping,
    memory_limit: str = "2GB",
) -> Iterator[Histories]:
    """Read histories from log files, folders and globs in batches of users, in sorted order.

    What the mapping leaves open is as in the training log. Rows beyond the memory limit, such as
    "2GB", spill to disk. InputError if a file or column is missing, or a value cannot be used.
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
    record = trained.record
    columns = {str(name) for name in getattr(frame, "columns", ())}
    computed = not stored and computes_with_reward(record.reward)
    # What the run remembers of its training log may mean columns of the frame.
    texts = " ".join([*record.data.mapping.values(), record.data.where or ""]).casefold()
    remembers = record.data.earliest is not None or not {*re.findall(r"\w+", texts)}.isdisjoint(
        column.casefold() for column in columns
    )
    if not (record.observation_size or computed or remembers) and mapping == LogMapping():
        by_id = session_by(trained) == schema.SESSION_ID
        plain = _read_plain(frame, by_id, record.data.duplicates)
        if plain is not None:
            return iter((plain,))
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


def _read_plain(frame: pd.DataFrame, by_id: bool, duplicates: str) -> Histories | None:
    """Read a frame that needs no SQL; None for any other frame.

    Its columns are `user_id`, `item_id`, `timestamp` (ms), with `by_id` also `session_id`, all
    int64, and `reward`, a number; no row is out of range.
    """
    names = {schema.USER_ID: "user", schema.ITEM_ID: schema.ITEM, schema.TIMESTAMP: "timestamp"}
    names |= {schema.SESSION_ID: "session"} if by_id else {}
    if not (
        type(frame) is pd.DataFrame
        and 0 < len(frame) <= _MOST_PLAIN_ROWS
        and sorted(map(str, frame.columns)) == sorted([*names, schema.REWARD])
        and all(frame[name].dtype == np.int64 for name in names)
        and frame[schema.REWARD].dtype in (np.float64, np.float32, np.int64, np.bool_)
    ):
        return None
    table = {short: frame[name].to_numpy() for name, short in names.items()}
    rewards, times = frame[schema.REWARD].to_numpy(np.float64), table[schema.TIMESTAMP]
    in_range = times.min() >= EARLIEST_MS and times.max() <= time.time() * 1000
    # A comparison with NaN is false too.
    if not (in_range and (np.abs(rewards) <= schema.LARGEST_REWARD).all()):
        return None
    table |= {schema.REWARD: rewards, "row": np.arange(len(frame))}
    order = choose_rows(table, duplicates)
    table = take_rows(table, order)
    users, owner, counts = np.unique(table["user"], return_inverse=True, return_counts=True)
    recent = np.cumsum(counts)[owner] - np.arange(len(owner)) <= LONGEST_HISTORY
    items, codes = np.unique(table[schema.ITEM], return_inverse=True)
    seen_owner, seen = np.divmod(np.unique(owner * len(items) + codes), len(items))
    return Histories(
        users=users,
        owner=owner[recent],
        item_ids=table[schema.ITEM][recent],
        rewards=table[schema.REWARD][recent].astype(np.float32),
        timestamps=table[schema.TIMESTAMP][recent],
        session_ids=table["session"][recent] if by_id else None,
        seen_owner=seen_owner,
        seen_ids=items[seen],
        observations=None,
    )


def session_by(trained: TrainedPolicy) -> str:
    """How `read_histories` splits the sessions of the run's logs."""
    by_id = trained.record.session_by == schema.SESSION_ID
    return schema.SESSION_ID if by_id else "user"
