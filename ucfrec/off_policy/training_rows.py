"""Finds out whether a policy is evaluated on rows that it was trained on."""

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.arrays import Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs.kept import mixed
from ucfrec.runs.trained_policy import TrainedPolicy

MOST_SEEN: Final = 0.05
"""Largest share of rows seen in training with which an estimate is accepted. It is above 0 because
with coarse timestamps some rows of other logs have the same user, item and time coincidentally."""

KeyArray = npt.NDArray[np.uint64]


def share_seen(trained: TrainedPolicy, logged: EpisodeStore) -> float | None:
    """Compute the share of logged rows that are in the run's training or validation data.

    Rows are the same if their user, item and time are. A refit was trained on its test split too.

    Args:
        trained: the policy, with the record of its run.
        logged: a store that numbers users and items as the run's store does
            (`ucfrec.logs.prepare(like=…)`).

    Returns:
        The share, from 0 to 1, or None if the run's store has been moved, deleted or changed.
    """
    record = trained.record
    if record.fingerprint == logged.record.fingerprint:
        held_out = np.zeros(logged.n_episodes, dtype=bool)
        if record.refit_of is None:
            held_out = logged.episode_values(schema.SPLIT) == schema.SPLITS.index("test")
        return float((~held_out)[logged.all_steps()[0]].mean())
    return share_of_rows_seen(trained, np.concatenate(list(_keys(logged))))


def share_of_rows_seen(trained: TrainedPolicy, keys: KeyArray) -> float | None:
    """`share_seen` of rows by their `row_keys`."""
    store = readable_store(trained)
    if store is None:
        return None
    keys, rows = np.unique(keys, return_counts=True)
    seen = np.zeros(len(keys), dtype=bool)
    # The training data may be far larger than the logs.
    for name in schema.SPLITS if trained.record.refit_of is not None else ("train", "validation"):
        for learnt in _keys(store.split(name)):
            places = np.minimum(np.searchsorted(keys, learnt), len(keys) - 1)
            seen[places[keys[places] == learnt]] = True
    return float(rows[seen].sum() / rows.sum())


def readable_store(trained: TrainedPolicy) -> EpisodeStore | None:
    """The store that the run was trained on; None where it is gone, changed or damaged."""
    try:
        return trained.training_store()
    except InputError:
        return None


def seen_too_often(seen: float | None) -> list[str]:
    """What to say of a share of rows seen in training (`share_seen`); nothing if it is small."""
    if seen is None or seen <= MOST_SEEN:
        return []
    return [
        f"{seen:.0%} of the rows were seen in training: on these a policy looks "
        "better than it is; give later logs, or no logs for the test split"
    ]


def _keys(store: EpisodeStore) -> Iterator[KeyArray]:
    """Hash the (user, item, time) of each step to one number; some at a time, in order."""
    if not store.n_episodes:
        return
    users: Array = store.episode_values(schema.USER)
    for episodes, steps in store.step_batches():
        yield row_keys(
            users[episodes],
            store.step_values(schema.ITEM, episodes, steps),
            store.step_values(schema.TIMESTAMP, episodes, steps),
        )


def row_keys(users: Array, items: Array, times: Array) -> KeyArray:
    """(N,) hash of each row's numbers of user and item, and its time (ms)."""
    keys = np.zeros(len(users), dtype=np.uint64)
    for values in (users, items, times):
        keys = mixed(keys ^ values.astype(np.int64).view(np.uint64))
    return keys
