"""Whether a policy is evaluated on rows that it was trained on."""

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.runs.trained_policy import TrainedPolicy

MOST_SEEN: Final = 0.05
"""Share of rows seen in training above which no estimate stands. Where clocks are coarse, some rows
of other logs have the same user, item and time by chance."""

KeyArray = npt.NDArray[np.uint64]


def share_seen(trained: TrainedPolicy, logged: EpisodeStore) -> float | None:
    """Share of the logged rows whose (user, item, time) the run learnt from or was chosen on.

    Args:
        logged: a store with the users and items of the run's own (`ucfrec.logs.prepare(like=…)`).

    Returns:
        None where the run's store is no longer where it was.
    """
    record = trained.record
    if record["fingerprint"] == logged.meta["fingerprint"]:
        return 1.0
    try:
        store = EpisodeStore.open(Path(record["store"]))
    except InputError:
        return None
    if store.meta["fingerprint"] != record["fingerprint"]:
        return None
    learnt = np.concatenate([_keys(store.split(name)) for name in ("train", "validation")])
    return float(np.isin(_keys(logged), learnt).mean())


def _keys(store: EpisodeStore) -> KeyArray:
    """(N,) one number for each step's (user, item, time); a user never seen has a new one."""
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
    """Different numbers for different numbers, spread over all 64 bits (SplitMix64)."""
    keys = keys + np.uint64(0x9E3779B97F4A7C15)
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(keys ^ (keys >> np.uint64(31)))
