"""What users were shown, read as the training logs of a run were read."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pandas as pd
import pyarrow as pa

from ucfrec import schema
from ucfrec.logs.histories import frame_histories, read_histories
from ucfrec.logs.mapping import LogMapping
from ucfrec.runs.trained_policy import TrainedPolicy

LONGEST_HISTORY = 1000
"""Rows of a user that are read at most."""

Array = npt.NDArray[Any]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Histories:
    """What U users were shown: N rows, users one after the other, each user's in order of time."""

    users: Array
    """(U,) identifiers."""
    owner: IntArray
    """(N,) user, 0 to U − 1, of each row; sorted."""
    item_ids: Array
    """(N,)."""
    rewards: npt.NDArray[np.float32]
    """(N,)."""
    timestamps: IntArray
    """(N,) milliseconds."""
    session_ids: Array | None
    """(N,), where sessions are told apart by them."""
    seen_owner: IntArray
    """(M,) user of each item to filter; sorted."""
    seen_ids: Array
    """(M,) items that a user has seen, however long ago."""
    observations: npt.NDArray[np.float32] | None
    """(U, O) last logged observation."""

    @classmethod
    def from_batch(cls, batch: pa.RecordBatch) -> Self:
        """From a batch of `ucfrec.logs.read_histories`."""
        owner, item_ids = _flat(batch.column("item_ids"))
        seen_owner, seen_ids = _flat(batch.column("seen"))
        session_ids = observations = None
        if "session_ids" in batch.schema.names:
            session_ids = _flat(batch.column("session_ids"))[1]
        if schema.OBSERVATION in batch.schema.names:
            column = batch.column(schema.OBSERVATION)
            observations = np.asarray(column.flatten(), np.float32).reshape(len(column), -1)
        return cls(
            users=np.asarray(batch.column(schema.USER_ID)),
            owner=owner,
            item_ids=item_ids,
            rewards=_flat(batch.column("rewards"))[1].astype(np.float32),
            timestamps=_flat(batch.column("timestamps"))[1].astype(np.int64),
            session_ids=session_ids,
            seen_owner=seen_owner,
            seen_ids=seen_ids,
            observations=observations,
        )

    def latest_session(self, gap_ms: float | None) -> "Histories":
        """The same users with only the rows of the session of their last row.

        That session is the one with the same `session_ids`, if there are any; otherwise it begins
        after the last pause of more than `gap_ms`, or with the first row if `gap_ms` is None.
        """
        row = np.arange(len(self.owner))
        latest = np.zeros(len(self.users), dtype=np.int64)
        if self.session_ids is not None:
            latest[self.owner] = row  # the last of a user's rows is written last
            return self.rows(self.session_ids == self.session_ids[latest[self.owner]])
        if gap_ms is None:
            return self
        begins = np.zeros(len(self.owner), dtype=np.int64)
        begins[1:] = (np.diff(self.owner) > 0) | (np.diff(self.timestamps) > gap_ms)
        np.maximum.at(latest, self.owner, row * begins)
        return self.rows(row >= latest[self.owner])

    def rows(self, keep: BoolArray) -> "Histories":
        """The same users with only the rows (N,) to keep."""
        kept = {
            name: getattr(self, name)[keep]
            for name in ("owner", "item_ids", "rewards", "timestamps", "session_ids")
            if getattr(self, name) is not None
        }
        return replace(self, **kept)


def histories_of_files(
    trained: TrainedPolicy, files: Sequence[str | Path], mapping: LogMapping
) -> Iterator[Histories]:
    """Logs in files, a batch of users at a time, users in sorted order.

    Args:
        trained: whose reward expression, sessions and observations the logs have.
        files: log files, folders and globs.
        mapping: what their columns mean.

    Raises:
        InputError: the logs cannot be used.
    """
    batches = read_histories(
        files,
        _columns_used(trained, mapping),
        trained.record["reward"],
        LONGEST_HISTORY,
        session_by=_session_by(trained),
    )
    return map(Histories.from_batch, batches)


def histories_of_frame(
    trained: TrainedPolicy, frame: pd.DataFrame, mapping: LogMapping
) -> Iterator[Histories]:
    """The same of a frame in memory. Its rewards are its column `reward`, where it has one, or the
    run's reward expression over its columns.

    Raises:
        InputError: the frame cannot be used.
    """
    given = schema.REWARD in getattr(frame, "columns", ())
    batches = frame_histories(
        frame,
        _columns_used(trained, mapping),
        schema.REWARD if given else trained.record["reward"],
        LONGEST_HISTORY,
        session_by=_session_by(trained),
    )
    return map(Histories.from_batch, batches)


def _columns_used(trained: TrainedPolicy, mapping: LogMapping) -> LogMapping:
    if trained.record["observation_size"]:
        return mapping
    return LogMapping({schema.OBSERVATION: ""}).over(mapping)


def _session_by(trained: TrainedPolicy) -> str:
    by_id = trained.record.get("session_by") == schema.SESSION_ID
    return schema.SESSION_ID if by_id else "user"


def _flat(lists: pa.ListArray) -> tuple[IntArray, Array]:
    """Row of each element, and the elements, of a column of lists."""
    lengths = np.diff(np.asarray(lists.offsets))
    owner: IntArray = np.repeat(np.arange(len(lengths)), lengths)
    return owner, np.asarray(lists.flatten())
