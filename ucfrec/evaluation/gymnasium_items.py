"""Item features of Gymnasium environments, from a file or from the environment."""

from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec.arrays import Array
from ucfrec.errors import InputError
from ucfrec.files.parquet import require_regular
from ucfrec.schema import ITEM_ID

FEATURES: Final = "features"
"""Column of the item table with an array's numbers."""
TAGS: Final = "tags"
"""Column of the item table with the numbers of an array's true columns."""


def item_table(source: str, env: gymnasium.Env[Any, Any], n_items: int) -> pa.Table:
    """The features of an environment's items.

    `source` names a file (`.npy`, `.parquet`) or else an attribute of the environment, with dots
    for attributes of attributes. Row i of an array belongs to action i: numbers (n_items,) or
    (n_items, D) become the column `features`, booleans (n_items, D) the column `tags`, the list of
    the columns that are true. A Parquet file has a column `item_id` with the numbers of the
    actions, and its other columns are kept.

    Returns:
        One row per action in their order, with the column `item_id`: 0, 1, ….

    Raises:
        InputError: the file or attribute is missing, is of another kind or shape, or has numbers
            that are not finite.
    """
    if source.endswith((".parquet", ".npy")):
        require_regular(Path(source))
    try:
        if source.endswith(".parquet"):
            return _ordered(pq.read_table(source), source, n_items)
        if source.endswith(".npy"):
            return _table(np.load(source, allow_pickle=False), source, n_items)
    except (OSError, ValueError) as error:
        raise InputError(f"--item-features {source} cannot be read ({error})") from None
    name, _, path = source.partition(".")
    try:
        value = env.get_wrapper_attr(name)
        return _table(np.asarray(attrgetter(path)(value) if path else value), source, n_items)
    except AttributeError as error:
        raise InputError(
            f"--item-features {source} is neither a .npy or .parquet file nor an attribute of the "
            f"environment ({error})"
        ) from None


def _table(values: Array, source: str, n_items: int) -> pa.Table:
    """The item table of an array (n_items,) or (n_items, D)."""
    numbers = values.dtype.kind in "biuf"
    if not numbers or values.ndim not in (1, 2) or len(values) != n_items:
        raise InputError(
            f"--item-features {source} is an array of {values.dtype} of shape {values.shape}; give "
            f"numbers with one row for each of the {n_items} items"
        )
    ids = pa.array(np.arange(n_items))
    if values.dtype.kind == "b" and values.ndim == 2:
        return pa.table({ITEM_ID: ids, TAGS: [np.flatnonzero(row) for row in values]})
    if not np.isfinite(values).all():
        raise InputError(f"--item-features {source} has numbers that are not finite")
    column = values.astype(np.float64) if values.ndim == 1 else list(values.astype(np.float32))
    return pa.table({ITEM_ID: ids, FEATURES: pa.array(column)})


def _ordered(table: pa.Table, source: str, n_items: int) -> pa.Table:
    """The rows of a Parquet file, in the order of the actions."""
    if ITEM_ID not in table.column_names or not pa.types.is_integer(table[ITEM_ID].type):
        raise InputError(
            f"--item-features {source} has no whole numbers as {ITEM_ID}; name the column of the "
            f"actions' numbers {ITEM_ID}"
        )
    ids = np.asarray(table[ITEM_ID])
    order = np.argsort(ids)
    if not np.array_equal(ids[order], np.arange(n_items)):
        raise InputError(
            f"--item-features {source} has {len(ids)} rows; give each {ITEM_ID} from 0 to "
            f"{n_items - 1} once"
        )
    return table.take(pa.array(order))
