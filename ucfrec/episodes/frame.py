"""The steps of a store as a data frame, with the identifiers of the logs."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError
from ucfrec.files.parquet import read_ids

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore

_FILES: Final = {schema.ITEM_ID: "items.parquet", schema.USER_ID: "users.parquet"}
_PLAIN: Final = (schema.TIMESTAMP, schema.REWARD, schema.PROPENSITY, schema.IS_RANDOM)
_LISTS: Final = (schema.OBSERVATION, schema.ACTION)


def store_frame(store: "EpisodeStore") -> pd.DataFrame:
    """One row per step, session by session: `user_id`, `session_id` (the number of the session in
    the store), `item_id` or `action`, the other columns of the log that the store has, and `split`.

    Raises:
        InputError: the view has augmented episodes, or a file of the store is damaged.
    """
    if store.overlay is not None:
        raise InputError(f"{store} has augmented episodes; take its without_augmentation()")
    episodes, steps = store.all_steps()
    columns: dict[str, Any] = {}
    if store.has_users:
        users = store.episode_values(schema.USER)[episodes]
        columns[schema.USER_ID] = _named(store, schema.USER_ID, users)
    columns[schema.SESSION_ID] = store.episode_ids[episodes]
    if store.has_items:
        items = store.step_values(schema.ITEM, episodes, steps)
        columns[schema.ITEM_ID] = _named(store, schema.ITEM_ID, items)
    for name in _PLAIN:
        if name in store.record.columns:
            columns[name] = store.step_values(name, episodes, steps)
    for name in _LISTS:
        if name in store.record.columns:
            columns[name] = list(store.step_values(name, episodes, steps))
    splits = store.episode_values(schema.SPLIT)[episodes]
    columns[schema.SPLIT] = np.asarray(schema.SPLITS, dtype=object)[splits]
    return pd.DataFrame(columns)


def _named(store: "EpisodeStore", column: str, numbers: IntArray) -> Array:
    """Identifiers of the logs; the numbers themselves in a store without their table."""
    path = store.path / _FILES[column]
    return read_ids(path, column)[numbers] if path.exists() else numbers
