"""Groups of items alike, by their embeddings: for marginalised weights and tests by group."""

import numpy as np

from ucfrec.arrays import Float32Array, IntArray

_MOST_GROUPS = 32


def default_groups(items: int) -> int:
    """How many groups a catalogue has: the root of its items, from 2 to 32."""
    return int(np.clip(round(items**0.5), 2, _MOST_GROUPS))


def group_items(embeddings: Float32Array, groups: int, seed: int) -> IntArray:
    """(n_items,) group of every item, from 0, by k-means of embeddings (n_items, D).

    Items of equal embeddings are in one group, so there may be fewer than `groups`.
    """
    # Importing scikit-learn takes a second, which no other estimate must cost.
    from sklearn.cluster import KMeans

    distinct = len(np.unique(embeddings, axis=0))
    means = KMeans(min(groups, distinct), n_init=4, random_state=seed).fit(embeddings)
    return np.asarray(np.unique(means.labels_, return_inverse=True)[1], dtype=np.int64)
