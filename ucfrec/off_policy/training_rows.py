"""Finds out whether a policy is evaluated on rows that it was trained on."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.runs.trained_policy import TrainedPolicy, store_of

MOST_SEEN: Final = 0.05
"""Largest share of rows seen in training with which an estimate is accepted. It is above 0 because
with coarse timestamps some rows of other logs have the same user, item and time by chance."""

KeyArray = npt.NDArray[np.uint64]


def share_seen(trained: TrainedPolicy, logged: EpisodeStore) -> float | None:
    """Compute the share of logged rows that are in the run's training or validation data.

    Rows are the same if their user, item and time are.

    Args:
        trained: the policy, with the record of its run.
        logged: a store that numbers users and items as the run's store does
            (`ucfrec.logs.prepare(like=…)`).

    Returns:
        The share, from 0 to 1, or None if the run's store has been moved, deleted or changed.
    """
    record = trained.record
    if record["fingerprint"] == logged.meta["fingerprint"]:
        return 1.0
    try:
        store = store_of(trained.folder, record)
    except InputError:
        return None
    if store is None:
        return None
    learnt = np.concatenate([_keys(store.split(name)) for name in ("train", "validation")])
    return float(np.isin(_keys(logged), learnt).mean())


def _keys(store: EpisodeStore) -> KeyArray:
    """Hash the (user, item, time) of each step to one number, (N,)."""
    if not store.n_episodes:
        return np.zeros(0, dtype=np.uint64)
    episodes, steps = store.all_steps()
    users: npt.NDArray[Any] = store.episode_values(schema.USER)[episodes]
    keys = np.zeros(len(steps), dtype=np.uint64)
    for values in (
        users,
        store.step_values(schema.ITEM, episodes, steps),
        store.step_values(schema.TIMESTAMP, episodes, steps),
    ):
        keys = _mixed(keys ^ values.astype(np.int64).view(np.uint64))
    return keys


def _mixed(keys: KeyArray) -> KeyArray:
    """Spread numbers over all 64 bits; different inputs give different outputs (SplitMix64)."""
    keys = keys + np.uint64(0x9E3779B97F4A7C15)
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(keys ^ (keys >> np.uint64(31)))
