"""Item embeddings and user features of a store, learnt from the training split only.

A policy that was trained on them goes on with those of a store that has grown, so these lie in the
same space: old rows stay where they are.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
from scipy import sparse

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.episodes.item_table import DISTINCT_TAGS, ITEM_STATES, write_item_table
from ucfrec.episodes.record import StoreRecord
from ucfrec.logs.features import EncodedFeatures
from ucfrec.logs.rows import keep_users_whole
from ucfrec.logs.sessions import Moments
from ucfrec.processes import require_blas_memory

PRIOR_COUNT = 3.0
"""Number of times shown at which co-occurrence and features have equal weight for an item."""
RIDGE = 1.0
"""L2 penalty of the regression of co-occurrence embeddings on features."""
CONTENT_RANK = 64
"""Most feature dimensions in that regression."""
USER_SIZE = 32
"""Most dimensions of the user features."""
BLOCK_STEPS = 2**19
"""Training steps in memory at a time, or more if one user has more."""
EXPOSURE = 0.25
"""Weight of an impression without any liking; full liking adds 1."""
_OVERSAMPLES = 10
_SMALL = 1e-10
"""Eigenvalues below this share of the largest are rounding errors."""
_ALIKE = 0.5
"""Share of items that two tags must have in common (Jaccard) to be the same tag."""


def read_training_steps(folder: Path, shards: Iterable[int]) -> Iterator[dict[str, Array]]:
    """The `user`, `item` and `reward` of training steps of some shards of a store, in order."""
    for number in shards:
        shard = folder / f"shard-{number:05d}"
        items, rewards = (
            np.load(shard / f"{name}.npy", mmap_mode="r") for name in (schema.ITEM, schema.REWARD)
        )
        offsets, users, splits = (
            np.load(shard / f"{name}.npy") for name in (schema.OFFSETS, schema.USER, schema.SPLIT)
        )
        begin = 0
        while begin < len(users):
            end = int(np.searchsorted(offsets, offsets[begin] + BLOCK_STEPS))
            end = min(max(end, begin + 1), len(users))
            lengths = np.diff(offsets[begin : end + 1])
            training = np.repeat(splits[begin:end] == 0, lengths)
            rows = slice(int(offsets[begin]), int(offsets[end]))
            yield {
                schema.USER: np.repeat(users[begin:end], lengths)[training],
                schema.ITEM: items[rows][training].astype(np.int64),
                schema.REWARD: rewards[rows][training].astype(np.float64),
            }
            begin = end


def write_item_states(
    folder: Path,
    scratch: Path,
    encoded: EncodedFeatures,
    size: int,
) -> None:
    """Learn and write the item embeddings (at most `size` dimensions) and user features of the
    store at `folder`. Where all rewards of the training split are equal, all are high."""
    shards = range(StoreRecord.read(folder).n_shards)
    moments = Moments(1)
    for batch in read_training_steps(folder, shards):
        moments.add(batch[schema.REWARD])
    low, usual = moments.lowest[0], moments.mean[0] + 2 * np.sqrt(moments.covariance[0, 0])
    high = min(moments.highest[0], usual)
    low = low if low < high else high - 1
    matrix = Exposure(scratch / "exposure.bin", encoded.item_counts)
    for batch in keep_users_whole(read_training_steps(folder, shards), schema.USER):
        liking = np.clip((batch[schema.REWARD] - low) / (high - low), 0, 1)
        matrix.add(batch[schema.USER], batch[schema.ITEM], EXPOSURE + liking)
    embeddings = item_embeddings(matrix, encoded.items, size)
    user_vectors = np.zeros((len(encoded.user_counts), 0), dtype=np.float32)
    if encoded.users is not None:
        trained_rows = np.flatnonzero(encoded.user_counts)
        user_vectors = _reduce(encoded.users, trained_rows, USER_SIZE)
        spread = user_vectors[trained_rows].std(axis=0)
        user_vectors /= np.where(spread > 0, spread, 1)
    write_item_table(folder / ITEM_STATES, embeddings, user_vectors, encoded.tags, low, high)


class Exposure:
    """The user × item matrix of exposure and liking, on disk."""

    def __init__(self, path: Path, counts: IntArray) -> None:
        """Of items with (n_items,) numbers of training steps that show each; `path` is scratch."""
        self.counts = counts
        self.trained = np.flatnonzero(counts)
        """Items that are shown: item of each column."""
        self._column = np.cumsum(counts > 0) - 1
        self._rows = SparseRows(path, len(self.trained))
        self._by_item = np.zeros(len(self.trained))

    def add(
        self,
        users: IntArray,
        items: IntArray,
        weights: Float64Array,
    ) -> None:
        """Add steps (M,), all of a user in a row; weights (above 0) of a user and item add up."""
        rows = np.cumsum(np.append(False, users[1:] != users[:-1]))
        shape = (int(rows[-1]) + 1, len(self.trained))
        block = sparse.coo_matrix((weights, (rows, self._column[items])), shape=shape).tocsr()
        block.data = np.log1p(block.data)
        self._by_item += np.asarray(block.sum(axis=0, dtype=np.float64)).ravel()
        by_user = np.sqrt(np.asarray(block.sum(axis=1, dtype=np.float64)).ravel())
        block.data /= np.repeat(by_user, np.diff(block.indptr))
        self._rows.append(block)

    def cooccurrence(self, size: int) -> Float64Array:
        """(trained items, ≤ size) unit rows from the SVD of the matrix."""
        by_item = np.sqrt(self._by_item)
        rank = min(size + 1, min(self._rows.shape))
        require_blas_memory()
        strength, directions = right_singular_vectors(self._rows, by_item, rank)
        # One direction holds only the popularity of items (the trivial axis of correspondence
        # analysis) and has the largest singular value; it would dominate the others.
        popular = by_item / np.linalg.norm(by_item)
        directions = directions - np.outer(directions @ popular, popular)
        left = np.linalg.norm(directions, axis=1)
        # Directions beyond the rank of the matrix are 0 from the start.
        trivial = np.where(strength > 0, left, np.inf).argmin()
        nontrivial = np.delete(np.arange(rank), trivial) if rank > 1 else np.arange(1)
        return _unit_rows((np.sqrt(strength)[nontrivial, None] * directions[nontrivial]).T)


def item_embeddings(
    exposure: Exposure, features: sparse.csr_matrix | None = None, size: int = 32
) -> Float32Array:
    """(n_items, D) float32 embeddings by co-occurrence in users' histories and by features.

    The co-occurrence part is the truncated SVD of the user × item matrix of exposure and liking,
    scaled to unit rows, averaged with the prediction of a ridge regression from the item's features
    (n_items, F), which weighs more the fewer times the item was shown. With features, up to half of
    the dimensions, at most `size`, are these, reduced by SVD. No embedding has a norm above 1.
    """
    trained = exposure.trained
    counts = exposure.counts[trained]
    content = None if features is None else _unit_rows(_reduce(features, trained, size // 2))
    remaining = size if content is None else max(size - content.shape[1], 1)
    cooccurrence = exposure.cooccurrence(remaining)
    trust = (counts / (counts + PRIOR_COUNT))[:, None]
    combined = np.zeros((len(exposure.counts), cooccurrence.shape[1]))
    if features is not None:
        combined = predict_from_features(features, trained, cooccurrence, counts)
    combined[trained] = trust * cooccurrence + (1 - trust) * combined[trained]
    if content is None:
        return np.asarray(combined, dtype=np.float32)
    return np.asarray(np.hstack([combined, content]) / np.sqrt(2), dtype=np.float32)


def predict_from_features(
    features: sparse.csr_matrix,
    trained: IntArray,
    cooccurrence: Float64Array,
    counts: IntArray,
) -> Float64Array:
    """(n_items, size) co-occurrence part predicted from features, by ridge regression."""
    axes = _axes(features[trained], CONTENT_RANK)
    trained_rows = np.asarray(features[trained] @ axes, dtype=np.float64)
    weights = counts / (counts + PRIOR_COUNT)
    gram = trained_rows.T @ (weights[:, None] * trained_rows) + RIDGE * np.eye(axes.shape[1])
    slopes = np.linalg.solve(gram, trained_rows.T @ (weights[:, None] * cooccurrence))
    # Sparse times dense is computed row by row, so an item's result does not depend on other items.
    return np.asarray(features @ (axes @ slopes), dtype=np.float64)


def _reduce(features: sparse.csr_matrix, trained_rows: IntArray, size: int) -> Float32Array:
    """(n, ≤ size) features on the singular axes of the trained rows, centred on their mean."""
    rows: Array = np.asarray(features @ _axes(features[trained_rows], max(size, 1)))
    rows -= rows[trained_rows].mean(axis=0)
    # A row without any feature is at the mean.
    rows[np.diff(features.indptr) == 0] = 0
    return np.asarray(rows, dtype=np.float32)


def _axes(trained_rows: sparse.csr_matrix, size: int) -> Array:
    """(F, D ≤ `size`) right singular vectors of the rows; the identity if F ≤ `size`."""
    if trained_rows.shape[1] <= size:
        return np.eye(trained_rows.shape[1])
    from sklearn.utils.extmath import randomized_svd  # takes seconds to import

    require_blas_memory()
    rank = min(size, trained_rows.shape[0])
    return np.asarray(randomized_svd(trained_rows, rank, random_state=0)[2].T)


def _unit_rows(rows: Array) -> Array:
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(norms > 0, norms, 1)


class SparseRows:
    """A sparse matrix on disk, in blocks of consecutive rows."""

    def __init__(self, path: Path, n_columns: int) -> None:
        self._file: IO[bytes] = path.open("w+b")
        self._lengths: list[int] = []
        self.shape = (0, n_columns)

    def append(self, rows: sparse.csr_matrix) -> None:
        """Append rows with float32 values."""
        for array in (rows.data.astype(np.float32), rows.indices, rows.indptr):
            np.save(self._file, array)
        self._lengths.append(rows.shape[0])
        self.shape = (self.shape[0] + rows.shape[0], self.shape[1])

    def blocks(self) -> Iterator[sparse.csr_matrix]:
        self._file.seek(0)
        for rows in self._lengths:
            parts = tuple(np.load(self._file) for _ in range(3))
            yield sparse.csr_matrix(parts, shape=(rows, self.shape[1]))


def right_singular_vectors(
    matrix: SparseRows, by_column: Float64Array, rank: int
) -> tuple[Float64Array, Float64Array]:
    """Largest singular values (rank,) and right singular vectors (rank, n) of a matrix (m, n) whose
    columns are divided by `by_column` (n,).

    The randomised subspace iteration of Halko, Martinsson and Tropp (2011), as scikit-learn's
    `randomized_svd` but for rounding, signs (the largest entry of a vector is above 0) and memory:
    no matrix with a row for each row. Values beyond the rank are 0, and so are their vectors.
    """
    m, n = matrix.shape
    random = np.random.RandomState(0)
    width = rank + _OVERSAMPLES
    if m < n:
        basis = np.zeros((n, width))
        for block in matrix.blocks():
            basis += block.T @ random.normal(size=(block.shape[0], width)).astype(np.float32)
        basis /= by_column[:, None]
    else:
        basis = random.normal(size=(n, width))
    for _ in range(7 if rank < 0.1 * min(m, n) else 4):
        try:
            # Several times faster than a QR decomposition, and exact enough between iterations.
            basis = basis @ np.linalg.inv(np.linalg.cholesky(basis.T @ basis)).T
        except np.linalg.LinAlgError:
            basis, _ = np.linalg.qr(basis)
        basis = _there_and_back(matrix, by_column, basis)
    basis, _ = np.linalg.qr(basis)
    gram = np.zeros((basis.shape[1], basis.shape[1]))
    back = _there_and_back(matrix, by_column, basis, gram)
    if m < n:
        values, vectors = _largest(gram, rank)
        directions = (basis @ vectors).T
    else:
        # With A V = Q R, the right singular vectors of Qᵀ A are those of R⁻ᵀ (Aᵀ A V)ᵀ.
        roots, axes = _largest(gram, len(gram))
        projected = (back @ (axes * _inverse(roots))).T
        values, vectors = _largest(projected @ projected.T, rank)
        directions = (vectors * _inverse(values)).T @ projected
    signs = np.sign(directions[np.arange(rank), np.abs(directions).argmax(axis=1)])
    return values, directions * np.where(signs == 0, 1, signs)[:, None]


def _inverse(values: Float64Array) -> Float64Array:
    """1 / x, and 0 for 0."""
    return np.divide(1, values, out=np.zeros_like(values), where=values > 0)


def _largest(symmetric: Float64Array, rank: int) -> tuple[Float64Array, Float64Array]:
    """Square roots of the largest eigenvalues, descending, 0 for rounding errors; eigenvectors."""
    values, vectors = np.linalg.eigh(symmetric)
    values, vectors = values[::-1][:rank], vectors[:, ::-1][:, :rank]
    values = np.where(values > _SMALL * max(values[0], 0), values, 0)
    return np.sqrt(values), np.where(values > 0, vectors, 0)


def _there_and_back(
    matrix: SparseRows,
    by_column: Float64Array,
    basis: Float64Array,
    gram: Float64Array | None = None,
) -> Float64Array:
    """AᵀA V for the matrix A with divided columns and a basis V; adds (A V)ᵀ(A V) to `gram`."""
    scaled = (basis / by_column[:, None]).astype(np.float32)
    back = np.zeros(basis.shape)
    for block in matrix.blocks():
        product = block @ scaled
        if gram is not None:
            gram += product.T @ product
        back += block.T @ product
    return back / by_column[:, None]


def write_grown_states(
    store: Path,
    folder: Path,
    new_shards: Iterable[int],
    encoded: EncodedFeatures,
) -> None:
    """Write the item states of the store at `folder`, grown from `store` by `new_shards`.

    With feature tables, a ridge regression of the old vectors on the features predicts new ones.
    Without, new ones begin at the mean, and items move towards what their users were shown besides.
    """
    from ucfrec.episodes.states import ItemStates  # needs torch

    batches, old = [*read_training_steps(folder, new_shards)], ItemStates.load(store / ITEM_STATES)
    users, items, rewards = (
        np.concatenate([batch[name] for batch in batches])
        for name in (schema.USER, schema.ITEM, schema.REWARD)
    )
    step_counts = np.bincount(items, minlength=len(encoded.item_counts))
    old_counts = np.maximum(encoded.item_counts - step_counts, 0)
    vectors = _extend_rows(old.embeddings.numpy(), encoded.items, old_counts)
    if encoded.items is None and step_counts.any():
        liking = np.clip((rewards - old.reward_low) / (old.reward_high - old.reward_low), 0, 1)
        _, rows = np.unique(users, return_inverse=True)
        shape = (int(rows.max()) + 1, len(vectors))
        exposures = sparse.csr_matrix((EXPOSURE + liking, (rows, items)), shape=shape)
        vectors = _fold_in(vectors, exposures, old_counts, step_counts)
    features = _extend_rows(old.user_features.numpy(), encoded.users, encoded.user_counts)
    write_item_table(
        folder / ITEM_STATES,
        vectors.astype(np.float32),
        features.astype(np.float32),
        _number_tags(old.tags.numpy(), encoded.tags, len(vectors)),
        old.reward_low,
        old.reward_high,
    )


def _extend_rows(old: Float32Array, features: sparse.csr_matrix | None, counts: IntArray) -> Array:
    """(n, D): the old rows, and for others what their features predict, or the mean."""
    trained = np.flatnonzero(counts[: len(old)])
    mean = old[trained].mean(axis=0) if len(trained) else np.zeros(old.shape[1])
    rows = np.tile(mean, (len(counts), 1)).astype(np.float64)
    if features is not None and len(trained) and old.shape[1]:
        rows += predict_from_features(features, trained, old[trained] - mean, counts[trained])
        # Of an id without any feature nothing is predicted.
        rows[np.diff(features.indptr) == 0] = mean
    rows[: len(old)] = old
    return rows


def _fold_in(
    vectors: Float64Array,
    exposures: sparse.csr_matrix,
    old_counts: IntArray,
    step_counts: IntArray,
) -> Float64Array:
    """Vectors (n, D) moved towards the mean of their users' vectors, that of the items (users, n)
    shown, weighted by liking; new steps of an item weigh as much as old ones."""
    of_users = (exposures @ vectors) / np.asarray(exposures.sum(axis=1))
    folded = exposures.T @ (of_users - of_users.mean(axis=0))
    norms = np.linalg.norm(vectors[old_counts > 0], axis=1)
    lengths = np.linalg.norm(folded, axis=1, keepdims=True)
    folded *= (norms.mean() if len(norms) else 1.0) / np.where(lengths > 0, lengths, 1.0)
    share = (step_counts / (step_counts + old_counts + PRIOR_COUNT))[:, None]
    return np.asarray((1 - share) * vectors + share * folded)


def _number_tags(old: IntArray, new_tags: IntArray, n_items: int) -> IntArray:
    """(n_items, T) tags, those of new items, numbered otherwise in `new_tags` (n_items, T'), by the
    numbers of `old` (n_old, T); −1 for tags that the store lacks."""
    tags = np.full((n_items, old.shape[1]), -1, dtype=np.int64)
    tags[: len(old)] = old
    if not (old.shape[1] and new_tags.shape[1]):
        return tags
    # A new tag is the old one that most of the same items have.
    sizes = int(new_tags.max()) + 1, int(old.max()) + 1
    have_new, have_old = _incidence(new_tags[: len(old)], sizes[0]), _incidence(old, sizes[1])
    both = (have_new.T @ have_old).toarray()
    union = have_new.sum(axis=0).T + have_old.sum(axis=0) - both
    share = np.asarray(both / np.maximum(union, 1))
    best = share.argmax(axis=1)
    alike = np.flatnonzero(share.max(axis=1)[: DISTINCT_TAGS + 1] >= _ALIKE)
    same = dict(zip(alike.tolist(), best[alike].tolist(), strict=True))
    for item in range(len(old), n_items):
        shared = [same[tag] for tag in new_tags[item].tolist() if tag in same][: old.shape[1]]
        tags[item, : len(shared)] = shared
    return tags


def _incidence(tags: IntArray, size: int) -> sparse.csr_matrix:
    """(n, size) 1 where an item has a tag."""
    rows, columns = np.nonzero(tags >= 0)
    values = np.ones(len(rows))
    return sparse.csr_matrix((values, (rows, tags[rows, columns])), shape=(len(tags), size))
