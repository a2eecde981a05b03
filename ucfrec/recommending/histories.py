"""Users' histories, read in the same way as the training logs of a run."""

import re
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.episodes.item_table import IdLookup
from ucfrec.episodes.store import LONGEST_HISTORY
from ucfrec.errors import InputError
from ucfrec.logs.expressions import computes_with_reward
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import EARLIEST_MS, LogMapping
from ucfrec.logs.rows import choose_rows
from ucfrec.runs.trained_policy import TrainedPolicy, columns_used, reward_of

_MOST_PLAIN_ROWS = 1_000_000
"""Rows up to which a frame is read at once, not in batches of users."""


@dataclass(frozen=True)
class Histories:
    """Histories of U users: N rows, sorted by user and then by time."""

    users: Array
    """(U,) identifiers."""
    owner: IntArray
    """(N,) user index of each row, 0 to U − 1; sorted."""
    item_ids: Array
    """(N,) identifiers in the logs."""
    rewards: Float32Array
    """(N,) in reward units."""
    timestamps: IntArray
    """(N,) milliseconds."""
    session_ids: Array | None
    """(N,); None if sessions are not split by them."""
    seen_owner: IntArray
    """(M,) user index of each entry of `seen_ids`; sorted."""
    seen_ids: Array
    """(M,) identifiers of all items that a user has seen, also before the N rows."""
    observations: Float32Array | None
    """(U, O) last logged observation; None if the logs have none."""

    @classmethod
    def from_batch(cls, batch: pa.RecordBatch) -> Self:
        """Convert a batch of `ucfrec.logs.histories.read_histories`, one row per user."""
        owner, item_ids = _flatten(batch.column("item_ids"))
        seen_owner, seen_ids = _flatten(batch.column("seen"))
        session_ids = observations = None
        if "session_ids" in batch.schema.names:
            session_ids = np.asarray(batch.column("session_ids").flatten())
        if schema.OBSERVATION in batch.schema.names:
            column = batch.column(schema.OBSERVATION)
            observations = np.asarray(column.flatten(), np.float32).reshape(len(column), -1)
        return cls(
            users=np.asarray(batch.column(schema.USER_ID)),
            owner=owner,
            item_ids=item_ids,
            rewards=np.asarray(batch.column("rewards").flatten(), np.float32),
            timestamps=np.asarray(batch.column("timestamps").flatten(), np.int64),
            session_ids=session_ids,
            seen_owner=seen_owner,
            seen_ids=seen_ids,
            observations=observations,
        )

    @classmethod
    def from_plain(cls, frame: pd.DataFrame, by_id: bool, duplicates: str) -> Self | None:
        """Read a frame that needs no SQL; None for any other frame.

        Its columns are `user_id`, `item_id`, `timestamp` (ms), with `by_id` also `session_id`, all
        int64, and `reward`, a number; no row is out of range.
        """
        if type(frame) is not pd.DataFrame or not 0 < len(frame) <= _MOST_PLAIN_ROWS:
            return None
        names = {schema.USER_ID: "user", schema.ITEM_ID: schema.ITEM}
        names |= {schema.TIMESTAMP: schema.TIMESTAMP}
        names |= {schema.SESSION_ID: "session"} if by_id else {}
        if {*frame.columns} != {*names, schema.REWARD} or frame.shape[1] != len(names) + 1:
            return None
        table = {short: frame[name].to_numpy() for name, short in names.items()}
        if any(values.dtype != np.int64 for values in table.values()):
            return None
        if frame[schema.REWARD].dtype not in (np.float64, np.float32, np.int64, np.bool_):
            return None
        rewards, times = frame[schema.REWARD].to_numpy(np.float64), table[schema.TIMESTAMP]
        if times.min() < EARLIEST_MS or times.max() > time.time() * 1000:
            return None
        # A comparison with NaN is false too.
        if not (np.abs(rewards) <= schema.LARGEST_REWARD).all():
            return None
        table |= {schema.REWARD: rewards, "row": np.arange(len(frame))}
        order = choose_rows(table, duplicates)
        table = {name: values[order] for name, values in table.items()}
        users, items = table["user"], table[schema.ITEM]
        same_user = users[1:] == users[:-1]
        owner = np.concatenate([[0], np.cumsum(~same_user)])
        ends = np.append(np.flatnonzero(~same_user), len(users) - 1)
        recent = ends[owner] - np.arange(len(users)) < LONGEST_HISTORY
        by_item = np.lexsort((items, owner))
        seen_owner, seen = owner[by_item], items[by_item]
        new = np.append(True, (np.diff(seen_owner) > 0) | (np.diff(seen) != 0))
        return cls(
            users=users[ends],
            owner=owner[recent],
            item_ids=items[recent],
            rewards=table[schema.REWARD][recent].astype(np.float32),
            timestamps=table[schema.TIMESTAMP][recent],
            session_ids=table["session"][recent] if by_id else None,
            seen_owner=seen_owner[new],
            seen_ids=seen[new],
            observations=None,
        )

    @classmethod
    def joined(cls, parts: Sequence["Histories"]) -> "Histories":
        """The users of all parts, one part after the other; all have sessions, or none."""
        if len(parts) == 1:
            return parts[0]
        firsts = np.cumsum([0, *(len(part.users) for part in parts[:-1])])
        columns: dict[str, Array | None] = {}
        for column in fields(cls):
            values = [getattr(part, column.name) for part in parts]
            if column.name in ("owner", "seen_owner"):
                values = [owners + first for owners, first in zip(values, firsts, strict=True)]
            columns[column.name] = None if values[0] is None else np.concatenate(values)
        return Histories(**columns)  # type: ignore[arg-type]

    def with_numbers(self, ids: IdLookup, filter_seen: bool) -> "Histories":
        """The same with the numbers of the items in `ids`, −1 for unknown ones, and without
        `filter_seen` for all that were seen."""
        seen = ids.numbers(self.seen_ids) if filter_seen else np.full(len(self.seen_ids), -1)
        return replace(self, item_ids=ids.numbers(self.item_ids), seen_ids=seen)

    def latest_session(self, gap_ms: float | None, new: BoolArray | None = None) -> "Histories":
        """The same users with only the rows of each user's latest session.

        With `session_ids`, these are the rows with the session id of the user's last row. Without,
        the session begins after the last pause of more than `gap_ms` milliseconds, or with the
        user's first row if `gap_ms` is None. That of users who begin a `new` one (U,) has no rows.
        """
        if new is not None and new.any():
            return self.with_rows(~new[self.owner]).latest_session(gap_ms)
        row = np.arange(len(self.owner))
        latest = np.zeros(len(self.users), dtype=np.int64)
        if self.session_ids is not None:
            # Of repeated indices, the last assignment remains: each user's last row.
            latest[self.owner] = row
            return self.with_rows(self.session_ids == self.session_ids[latest[self.owner]])
        if gap_ms is None:
            return self
        begins = np.zeros(len(self.owner), dtype=np.int64)
        begins[1:] = (np.diff(self.owner) > 0) | (np.diff(self.timestamps) > gap_ms)
        np.maximum.at(latest, self.owner, row * begins)
        return self.with_rows(row >= latest[self.owner])

    def of_users(self, numbers: IntArray) -> "Histories":
        """The users with the given numbers (M,), in that order."""
        owner, rows = _find_rows(self.owner, numbers)
        seen_owner, seen = _find_rows(self.seen_owner, numbers)
        return replace(
            self.with_rows(rows),
            users=self.users[numbers],
            owner=owner,
            seen_owner=seen_owner,
            seen_ids=self.seen_ids[seen],
            observations=None if self.observations is None else self.observations[numbers],
        )

    def with_rows(self, rows: BoolArray | IntArray) -> "Histories":
        """The same users with only some rows: their numbers, or (N,) true for them."""
        return replace(
            self,
            owner=self.owner[rows],
            item_ids=self.item_ids[rows],
            rewards=self.rewards[rows],
            timestamps=self.timestamps[rows],
            session_ids=None if self.session_ids is None else self.session_ids[rows],
        )


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
    batches = read_histories(
        files,
        columns_used(trained, mapping),
        reward_of(trained),
        LONGEST_HISTORY,
        memory_limit,
        session_by=session_by(trained),
        duplicates=trained.record.data.duplicates,
    )
    return map(Histories.from_batch, batches)


def histories_of_frame(
    trained: TrainedPolicy, frame: pd.DataFrame, mapping: LogMapping, stored: bool = False
) -> Iterator[Histories]:
    """`histories_of_files` of a frame with one row per interaction.

    Rewards are the frame's column `reward`, unless the run's reward expression computes with a
    column of that name; otherwise that expression over the frame's columns.

    Args:
        stored: whether the frame is of a store, whose column `reward` is what was computed.
    """
    record, columns = trained.record, {str(name) for name in getattr(frame, "columns", ())}
    computed = not stored and computes_with_reward(record.reward)
    # What the run remembers of its training log may mean columns of the frame.
    texts = " ".join([*record.data.mapping.values(), record.data.where or ""]).casefold()
    remembers = record.data.earliest is not None or not {*re.findall(r"\w+", texts)}.isdisjoint(
        column.casefold() for column in columns
    )
    if not (record.observation_size or computed or remembers) and mapping == LogMapping():
        by_id = session_by(trained) == schema.SESSION_ID
        plain = Histories.from_plain(frame, by_id, record.data.duplicates)
        if plain is not None:
            return iter((plain,))
    has_rewards = not computed and schema.REWARD in columns
    batches = frame_histories(
        frame,
        columns_used(trained, mapping),
        schema.REWARD if has_rewards else reward_of(trained),
        LONGEST_HISTORY,
        session_by=session_by(trained),
        duplicates=trained.record.data.duplicates,
    )
    return map(Histories.from_batch, batches)


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


def _find_rows(owner: IntArray, numbers: IntArray) -> tuple[IntArray, IntArray]:
    """Of the rows of the users `numbers` (M,), user by user: the place of the user among the M, and
    the index in `owner`, which is sorted."""
    starts, ends = (np.searchsorted(owner, numbers, side=side) for side in ("left", "right"))
    lengths = ends - starts
    place = np.repeat(np.arange(len(numbers)), lengths)
    return place, np.arange(len(place)) + (ends - np.cumsum(lengths))[place]


def session_by(trained: TrainedPolicy) -> str:
    """How `read_histories` splits the sessions of the run's logs."""
    by_id = trained.record.session_by == schema.SESSION_ID
    return schema.SESSION_ID if by_id else "user"


def _flatten(lists: pa.ListArray) -> tuple[IntArray, Array]:
    """Of a column of lists: the row index of each element, and the elements."""
    lengths = np.diff(np.asarray(lists.offsets))
    owner: IntArray = np.repeat(np.arange(len(lengths)), lengths)
    return owner, np.asarray(lists.flatten())
