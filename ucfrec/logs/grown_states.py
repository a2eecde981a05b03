"""Item vectors, tags and user features of a store that has grown: old rows stay where they are.

A policy that was trained on the old vectors goes on with the new ones, so these lie in the same
space.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy import sparse

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.episodes.item_table import DISTINCT_TAGS, ITEM_STATES, write_item_table
from ucfrec.episodes.states import ItemStates
from ucfrec.logs.features import encode_features, item_tags
from ucfrec.logs.ids import ID_TABLES
from ucfrec.logs.items import (
    EXPOSURE,
    PRIOR_COUNT,
    TrainingSteps,
    joined_steps,
    predicted_from_features,
    steps_of_shards,
)
from ucfrec.logs.prepare import PreparedLog

_ALIKE = 0.5
"""Share of items that two tags must have in common (Jaccard) to be the same tag."""


def write_grown_states(
    store: Path, folder: Path, found: PreparedLog, new_shards: Iterable[int]
) -> None:
    """Write the item states of the store at `folder`, grown from `store`.

    With feature tables, new items and users have the vectors that a ridge regression of the old
    ones on the features predicts, and old ones keep theirs. Without, new ones begin at the mean,
    and items move towards what their users were shown besides as new training steps outweigh the
    old.

    Args:
        found: the new log, with the tables `users` and `items` of all ids.
        new_shards: those of the new log's steps.
    """
    steps = [*steps_of_shards(folder, new_shards)]
    old, log = ItemStates.load(store / ITEM_STATES), found.rows.log
    encoded, counts = {}, {}
    for name, table, _ in ID_TABLES:
        encoded[name] = encode_features(log.connection, found.features[name], table, name)
        rows = log.connection.sql(f"SELECT train_count FROM {table} ORDER BY number").fetchnumpy()
        counts[name] = rows["train_count"].astype(np.int64)
    items, users = schema.ITEM_ID, schema.USER_ID
    shown = np.zeros(len(counts[items]), dtype=np.int64)
    for batch in steps:
        shown += np.bincount(batch.items, minlength=len(shown))
    before = np.maximum(counts[items] - shown, 0)
    vectors = _extended(old.embeddings.numpy(), encoded[items], before)
    if encoded[items] is None:
        vectors = _moved(vectors, steps, before, shown, old)
    features = _extended(old.user_features.numpy(), encoded[users], counts[users])
    tags = item_tags(log.connection, found.features[items], "items", items)
    write_item_table(
        folder / ITEM_STATES,
        vectors.astype(np.float32),
        features.astype(np.float32),
        old.reward_low,
        old.reward_high,
        _tags(old.tags.numpy(), tags, len(vectors)),
    )


def _extended(old: Float32Array, features: sparse.csr_matrix | None, counts: IntArray) -> Array:
    """(n, D): the old rows, and for others what their features predict, or the mean."""
    known = np.flatnonzero(counts[: len(old)])
    mean = old[known].mean(axis=0) if len(known) else np.zeros(old.shape[1])
    rows = np.tile(mean, (len(counts), 1)).astype(np.float64)
    if features is not None and len(known) and old.shape[1]:
        rows += predicted_from_features(features, known, old[known] - mean, counts[known])
        # Of an id without any feature nothing is predicted.
        rows[np.diff(features.indptr) == 0] = mean
    rows[: len(old)] = old
    return rows


def _moved(
    vectors: Float64Array,
    steps: Sequence[TrainingSteps],
    before: IntArray,
    shown: IntArray,
    old: ItemStates,
) -> Float64Array:
    """Vectors (n, D) moved towards the mean of their users' vectors, as of `folding in` (SVD).

    A user's vector is the mean of those of the items shown, weighted by liking. What an item has
    in new steps weighs as much as their number, against the number of old ones.
    """
    if not shown.any():
        return vectors
    new = joined_steps(steps)
    _, rows = np.unique(new.users, return_inverse=True)
    liking = np.clip((new.rewards - old.reward_low) / (old.reward_high - old.reward_low), 0, 1)
    weights = sparse.csr_matrix(
        (EXPOSURE + liking, (rows, new.items)), shape=(int(rows.max()) + 1, len(vectors))
    )
    of_users = (weights @ vectors) / np.asarray(weights.sum(axis=1))
    folded = weights.T @ (of_users - of_users.mean(axis=0))
    norms = np.linalg.norm(vectors[before > 0], axis=1)
    lengths = np.linalg.norm(folded, axis=1, keepdims=True)
    folded *= (norms.mean() if len(norms) else 1.0) / np.where(lengths > 0, lengths, 1.0)
    share = (shown / (shown + before + PRIOR_COUNT))[:, None]
    return np.asarray((1 - share) * vectors + share * folded)


def _tags(old: IntArray, given: IntArray, n_items: int) -> IntArray:
    """(n_items, T) tags by the old numbers; −1 for tags of new items that the store lacks.

    Args:
        old: (n_old, T).
        given: (n_items, T') of the new tables, numbered otherwise; T' is 0 without tables.
    """
    tags = np.full((n_items, old.shape[1]), -1, dtype=np.int64)
    tags[: len(old)] = old
    if not (old.shape[1] and given.shape[1]):
        return tags
    same = _same_tags(old, given[: len(old)])
    for item in range(len(old), n_items):
        known = [same[tag] for tag in given[item].tolist() if tag in same]
        tags[item, : len(known[: old.shape[1]])] = known[: old.shape[1]]
    return tags


def _same_tags(old: IntArray, given: IntArray) -> dict[int, int]:
    """Given number to the old number of the tag that most of the same items have."""
    sizes = int(given.max()) + 1, int(old.max()) + 1
    have = [_incidence(each, size) for each, size in zip((given, old), sizes, strict=True)]
    both = (have[0].T @ have[1]).toarray()
    union = have[0].sum(axis=0).T + have[1].sum(axis=0) - both
    share = np.asarray(both / np.maximum(union, 1))
    best = share.argmax(axis=1)
    return {
        tag: int(best[tag]) for tag in range(min(sizes[0], DISTINCT_TAGS + 1))
        if share[tag, best[tag]] >= _ALIKE
    }  # fmt: skip


def _incidence(tags: IntArray, size: int) -> sparse.csr_matrix:
    """(n, size) 1 where an item has a tag."""
    rows, columns = np.nonzero(tags >= 0)
    values = np.ones(len(rows))
    return sparse.csr_matrix((values, (rows, tags[rows, columns])), shape=(len(tags), size))
