"""Item embeddings and user features, learnt from the training split only."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy import sparse

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.episodes.item_table import ITEM_STATES, write_item_table
from ucfrec.episodes.record import StoreRecord
from ucfrec.errors import InputError
from ucfrec.logs.measures import Moments
from ucfrec.logs.spectral import SparseRows, right_singular_vectors
from ucfrec.processes import require_blas_memory

PRIOR_COUNT: Final = 3.0
"""Number of times shown at which co-occurrence and features have equal weight for an item."""
RIDGE: Final = 1.0
"""L2 penalty of the regression of co-occurrence embeddings on features."""
CONTENT_RANK: Final = 64
"""Most feature dimensions in that regression."""
USER_SIZE: Final = 32
"""Most dimensions of the user features."""
BLOCK_STEPS: Final = 2**19
"""Training steps in memory at a time, or more if one user has more."""
EXPOSURE: Final = 0.25
"""Weight of an impression without any liking; full liking adds 1."""


@dataclass(frozen=True)
class TrainingSteps:
    """Training steps in which those of one user follow each other."""

    users: IntArray
    """(M,) number of the user."""
    items: IntArray
    """(M,) number of the item."""
    rewards: Float64Array
    """(M,)."""


def training_steps(folder: Path) -> Iterator[TrainingSteps]:
    """The training steps of a store, in batches that end between two users.

    Args:
        folder: store of a log of items, as `prepare` writes it: in order of the users.
    """
    held: list[TrainingSteps] = []
    for batch in steps_of_shards(folder, range(StoreRecord.read(folder).n_shards)):
        held.append(batch)
        if sum(len(batch.users) for batch in held) < BLOCK_STEPS:
            continue
        joined = joined_steps(held)
        changes = np.flatnonzero(joined.users[1:] != joined.users[:-1])
        if not len(changes):
            held = [joined]
            continue
        end = int(changes[-1]) + 1
        yield _part(joined, slice(end))
        held = [_part(joined, slice(end, None))]
    if held:
        yield joined_steps(held)


def steps_of_shards(folder: Path, shards: Iterable[int]) -> Iterator[TrainingSteps]:
    """The training steps of some shards of a store, in batches, in order."""
    for number in shards:
        shard = folder / f"shard-{number:05d}"
        columns = {
            name: np.load(shard / f"{name}.npy", mmap_mode="r") for name in (schema.ITEM, "reward")
        }
        offsets, users, splits = (
            np.load(shard / f"{name}.npy") for name in (schema.OFFSETS, "user", "split")
        )
        begin = 0
        while begin < len(users):
            end = int(np.searchsorted(offsets, offsets[begin] + BLOCK_STEPS))
            end = min(max(end, begin + 1), len(users))
            lengths = np.diff(offsets[begin : end + 1])
            training = np.repeat(splits[begin:end] == 0, lengths)
            rows = slice(int(offsets[begin]), int(offsets[end]))
            yield TrainingSteps(
                np.repeat(users[begin:end], lengths)[training],
                columns[schema.ITEM][rows][training].astype(np.int64),
                columns["reward"][rows][training].astype(np.float64),
            )
            begin = end


def joined_steps(batches: Sequence[TrainingSteps]) -> TrainingSteps:
    """The steps of all batches as one."""
    return TrainingSteps(
        np.concatenate([batch.users for batch in batches]),
        np.concatenate([batch.items for batch in batches]),
        np.concatenate([batch.rewards for batch in batches]),
    )


def _part(batch: TrainingSteps, rows: slice) -> TrainingSteps:
    return TrainingSteps(batch.users[rows], batch.items[rows], batch.rewards[rows])


def write_item_states(
    folder: Path,
    scratch: Path,
    item_features: sparse.csr_matrix | None,
    user_features: sparse.csr_matrix | None,
    n_items: int,
    n_users: int,
    size: int,
    tags: IntArray | None = None,
) -> None:
    """Learn the item embeddings and user features of the store at `folder` and write them there.

    Args:
        folder: episode store, which receives the file of item states.
        scratch: folder for files that are of no use afterwards.
        item_features: (n_items, F) as from `ucfrec.logs.features.encode_features`; None for none.
        user_features: (n_users, G) likewise.
        tags: (n_items, T) as from `ucfrec.logs.features.item_tags`; None for none.

    Raises:
        InputError: the rewards of the training split are all equal.
    """
    counts = np.zeros(n_items, dtype=np.int64)
    trained = np.zeros(n_users, dtype=bool)
    moments, low, highest = Moments(1), np.inf, -np.inf
    for batch in training_steps(folder):
        counts += np.bincount(batch.items, minlength=n_items)
        trained[batch.users] = True
        moments.add(batch.rewards)
        low = min(low, float(batch.rewards.min(initial=np.inf)))
        highest = max(highest, float(batch.rewards.max(initial=-np.inf)))
    high = min(highest, float(moments.mean[0] + 2 * np.sqrt(moments.covariance[0, 0])))
    if not low < high:
        raise InputError(
            f"all {moments.count} rewards of the training split equal {low}; choose another reward"
        )
    matrix = Exposure(scratch / "exposure.bin", counts)
    for batch in training_steps(folder):
        liking = np.clip((batch.rewards - low) / (high - low), 0, 1)
        matrix.add(batch.users, batch.items, EXPOSURE + liking)
    embeddings = item_embeddings(matrix, item_features, size)
    user_vectors = np.zeros((n_users, 0), dtype=np.float32)
    if user_features is not None:
        trained_rows = np.flatnonzero(trained)
        user_vectors = _reduce(user_features, trained_rows, USER_SIZE)
        spread = user_vectors[trained_rows].std(axis=0)
        user_vectors /= np.where(spread > 0, spread, 1)
    write_item_table(folder / ITEM_STATES, embeddings, user_vectors, low, high, tags)


class Exposure:
    """The user × item matrix of exposure and liking, on disk."""

    def __init__(self, path: Path, counts: IntArray) -> None:
        """
        Args:
            counts: (n_items,) number of training steps that show each item.
        """
        self.counts = counts
        self.trained = np.flatnonzero(counts)
        """Items that are shown: item of each column."""
        self._column = np.cumsum(counts > 0) - 1
        self._rows = SparseRows(path, len(self.trained))
        self._by_item = np.zeros(len(self.trained))

    def add(self, users: IntArray, items: IntArray, weights: Float64Array) -> None:
        """Add steps.

        Args:
            users: (M,) user of each step; those of one user follow each other, in one call.
            items: (M,) item shown.
            weights: (M,) above 0; those of one user and item are added up.
        """
        if not len(users):
            return
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
        rank = min(size + 1, *self._rows.shape)
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
    """Embed items by co-occurrence in users' histories and by their features.

    The co-occurrence part is the truncated SVD of the user × item matrix of exposure and liking,
    scaled to unit rows. It is averaged with the prediction of a ridge regression from the item's
    features (zero without features), whose weight grows the fewer times the item was shown: an item
    never shown has the prediction alone. With features, up to half of the dimensions are the
    features themselves, reduced by SVD. No embedding has a norm above 1.

    Args:
        features: (n_items, F); None for none.
        size: largest D.

    Returns:
        (n_items, D) float32; D is below `size` if there are few users, items or features.
    """
    trained = exposure.trained
    counts = exposure.counts[trained]
    content = None if features is None else _unit_rows(_reduce(features, trained, size // 2))
    remaining = size if content is None else max(size - content.shape[1], 1)
    cooccurrence = exposure.cooccurrence(remaining)
    trust = (counts / (counts + PRIOR_COUNT))[:, None]
    combined = np.zeros((len(exposure.counts), cooccurrence.shape[1]))
    if features is not None:
        combined = predicted_from_features(features, trained, cooccurrence, counts)
    combined[trained] = trust * cooccurrence + (1 - trust) * combined[trained]
    if content is None:
        return np.asarray(combined, dtype=np.float32)
    return np.asarray(np.hstack([combined, content]) / np.sqrt(2), dtype=np.float32)


def predicted_from_features(
    features: sparse.csr_matrix,
    trained: IntArray,
    cooccurrence: Float64Array,
    counts: IntArray,
) -> Float64Array:
    """(n_items, size) co-occurrence part predicted from features, by ridge regression."""
    axes = _axes(features[trained], CONTENT_RANK)
    trained_rows = np.asarray(features[trained] @ axes, dtype=np.float64)
    weights = counts / (counts + PRIOR_COUNT)
    gram = trained_rows.T @ (weights[:, None] * trained_rows) + RIDGE * np.eye(
        trained_rows.shape[1]
    )
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
    _, _, directions = randomized_svd(
        trained_rows, min(size, trained_rows.shape[0]), random_state=0
    )
    return np.asarray(directions.T)


def _unit_rows(rows: Array) -> Array:
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(norms > 0, norms, 1)
