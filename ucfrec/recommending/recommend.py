"""The next items for users of a log, known from training or not."""

import difflib
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pandas as pd
import pyarrow as pa
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.errors import InputError
from ucfrec.runs.trained_policy import TrainedPolicy

RANK, SCORE = "rank", "score"
LONGEST_HISTORY = 1000
"""Rows of a user that are read at most."""
_USERS_AT_ONCE = 1024

Array = npt.NDArray[Any]
IntArray = npt.NDArray[np.int64]


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
        observations = None
        if schema.OBSERVATION in batch.schema.names:
            observations = np.array(batch.column(schema.OBSERVATION).to_pylist(), dtype=np.float32)
        return cls(
            users=np.asarray(batch.column(schema.USER_ID)),
            owner=owner,
            item_ids=item_ids,
            rewards=_flat(batch.column("rewards"))[1].astype(np.float32),
            timestamps=_flat(batch.column("timestamps"))[1].astype(np.int64),
            seen_owner=seen_owner,
            seen_ids=seen_ids,
            observations=observations,
        )

    @classmethod
    def from_frame(cls, frame: pd.DataFrame) -> Self:
        """From one row an interaction: `user_id`, `item_id`, `timestamp` (ms), `reward` and, where
        it was logged, `observation`; in any order.

        Raises:
            InputError: a column is missing.
        """
        for column in (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP, schema.REWARD):
            if column not in frame:
                near = difflib.get_close_matches(column, map(str, frame.columns), n=3)
                there = ", ".join(near or map(str, frame.columns))
                raise InputError(f"histories have no column {column!r}; the nearest are {there}")
        frame = frame.sort_values([schema.USER_ID, schema.TIMESTAMP], kind="stable")
        users, owner = np.unique(frame[schema.USER_ID].to_numpy(), return_inverse=True)
        item_ids = frame[schema.ITEM_ID].to_numpy()
        observations = None
        if schema.OBSERVATION in frame:
            last = np.flatnonzero(np.diff(owner, append=len(users)))
            observations = np.stack(frame[schema.OBSERVATION].iloc[last].to_list())
        return cls(
            users=users,
            owner=owner,
            item_ids=item_ids,
            rewards=frame[schema.REWARD].to_numpy(dtype=np.float32),
            timestamps=frame[schema.TIMESTAMP].to_numpy(dtype=np.int64),
            seen_owner=owner,
            seen_ids=item_ids,
            observations=observations,
        )

    def latest_session(self, gap_ms: float) -> "Histories":
        """The same users with only the rows after their last pause of more than `gap_ms`."""
        begins = np.zeros(len(self.owner), dtype=np.int64)
        row = np.arange(len(self.owner))
        begins[1:] = (np.diff(self.owner) > 0) | (np.diff(self.timestamps) > gap_ms)
        latest = np.zeros(len(self.users), dtype=np.int64)
        np.maximum.at(latest, self.owner, row * begins)
        return self.rows(row >= latest[self.owner])

    def rows(self, keep: npt.NDArray[np.bool_]) -> "Histories":
        """The same users with only the rows (N,) to keep."""
        columns = ("owner", "item_ids", "rewards", "timestamps")
        return replace(self, **{name: getattr(self, name)[keep] for name in columns})


def _flat(lists: pa.ListArray) -> tuple[IntArray, Array]:
    lengths = np.diff(np.asarray(lists.offsets))
    owner: IntArray = np.repeat(np.arange(len(lengths)), lengths)
    return owner, np.asarray(lists.flatten())


def recommend(
    trained: TrainedPolicy,
    batches: Iterable[Histories],
    k: int,
    *,
    target_return: float,
    filter_seen: bool = True,
    skip_unknown: bool = False,
) -> Iterator[pd.DataFrame]:
    """The `k` best next items of every user.

    A user's latest session is read as one that goes on: the state is what the policy would see at
    its next step, and `target_return` is asked of what is left. Users never seen in training are
    served from their rows alone.

    Args:
        filter_seen: leave out every item that the user has seen.
        skip_unknown: ignore rows of items that the policy does not know.

    Yields:
        A frame a batch: `user_id`, `rank` (from 1), `item_id`, `score` (log-probability); k rows a
        user, fewer where fewer items are left.

    Raises:
        InputError: the policy has no items, or does not know some of the logs' items.
    """
    if trained.item_states is None or trained.item_ids is None:
        raise InputError("this policy's actions are vectors, not items; there is nothing to rank")
    index = pd.Index(trained.item_ids)
    gap_ms = trained.record["session_gap_ms"]
    remaining = iter(batches)
    for batch in remaining:
        items = _positions(index, batch.item_ids)
        if (items < 0).any() and not skip_unknown:
            raise _unknown(index, [batch, *remaining])
        histories = batch.rows(items >= 0)
        if gap_ms is not None:
            histories = histories.latest_session(gap_ms)
        seen = _positions(index, batch.seen_ids)
        frames = []
        with tempfile.TemporaryDirectory(prefix="ucfrec-") as scratch:
            store = _next_steps(Path(scratch) / "store", trained, histories, index)
            for first in range(0, len(batch.users), _USERS_AT_ONCE):
                rows = np.arange(first, min(first + _USERS_AT_ONCE, len(batch.users)))
                scores = _scores(trained, store, rows, target_return)
                if filter_seen:
                    mine = slice(*np.searchsorted(batch.seen_owner, [rows[0], rows[-1] + 1]))
                    known = seen[mine] >= 0
                    whose = batch.seen_owner[mine][known] - first
                    scores[whose, seen[mine][known]] = -torch.inf
                frames.append(_ranked(batch.users[rows], trained.item_ids, scores, k))
        yield pd.concat(frames, ignore_index=True)


def _positions(index: "pd.Index[Any]", ids: Array) -> IntArray:
    """Where each of `ids` stands in `index`, −1 where it does not."""
    return np.asarray(index.get_indexer(pd.Index(ids)), dtype=np.int64)


def _unknown(index: "pd.Index[Any]", batches: Iterable[Histories]) -> InputError:
    rows, items = 0, set[Any]()
    for batch in batches:
        unknown = batch.item_ids[_positions(index, batch.item_ids) < 0]
        rows += len(unknown)
        items |= set(unknown.tolist())
    some = ", ".join(map(str, sorted(items)[:3])) + (", …" if len(items) > 3 else "")
    return InputError(
        f"{rows} rows have an item_id that the policy does not know ({len(items)} items: {some}); "
        "prepare and train on logs with them, or leave those rows out with --skip-unknown"
    )


def _next_steps(
    folder: Path, trained: TrainedPolicy, histories: Histories, index: "pd.Index[Any]"
) -> EpisodeStore:
    """A store of every user's session and one more step, the one to recommend for."""
    n_users = len(histories.users)
    # Row i moves down by one for every user before its own: that leaves a free row after each.
    at = np.arange(len(histories.owner)) + histories.owner
    lengths = np.bincount(histories.owner, minlength=n_users) + 1
    items = np.zeros(int(lengths.sum()), dtype=np.int64)
    rewards = np.zeros(len(items), dtype=np.float32)
    items[at], rewards[at] = _positions(index, histories.item_ids), histories.rewards
    columns: dict[str, Array] = {schema.ITEM: items, schema.REWARD: rewards}
    if trained.record["observation_size"]:
        if histories.observations is None:
            raise InputError("the policy was trained with observations; the logs have none")
        columns[schema.OBSERVATION] = np.repeat(histories.observations, lengths, axis=0)
    known = _positions(pd.Index(trained.user_ids), histories.users)
    EpisodeStore.write(folder, columns, lengths, {schema.USER: known})
    assert trained.item_states is not None
    trained.item_states.save(folder / ITEM_STATES)
    return EpisodeStore.open(folder)


def _scores(trained: TrainedPolicy, store: EpisodeStore, rows: IntArray, target: float) -> Tensor:
    """(rows, n_items) log-probabilities of the next item, asked for `target` from here on."""
    windows = store.windows(rows, store.lengths[rows] - 1, trained.policy.config.context)
    # What the session has earned since each step is in its returns-to-go already.
    return trained.log_probabilities(windows, target)


def _ranked(users: Array, item_ids: Array, scores: Tensor, k: int) -> pd.DataFrame:
    top = scores.topk(min(k, scores.shape[1]), dim=-1)
    rank = np.broadcast_to(np.arange(1, top.indices.shape[1] + 1), top.indices.shape)
    left = torch.isfinite(top.values).numpy()
    return pd.DataFrame(
        {
            schema.USER_ID: np.repeat(users, left.sum(1)),
            RANK: rank[left],
            schema.ITEM_ID: item_ids[top.indices.numpy()[left]],
            SCORE: top.values.numpy()[left],
        }
    )
