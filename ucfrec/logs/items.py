"""Item embeddings and user features, learnt from the training split only."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from sklearn.utils.extmath import randomized_svd

from ucfrec import schema
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.errors import InputError
from ucfrec.processes import require_blas_memory

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]

PRIOR_COUNT: Final = 3.0
"""Number of times shown at which co-occurrence and features have equal weight for an item."""
RIDGE: Final = 1.0
"""L2 penalty of the regression of co-occurrence embeddings on features."""
CONTENT_RANK: Final = 64
"""Most feature dimensions in that regression."""
USER_SIZE: Final = 32
"""Most dimensions of the user features."""
EXPOSURE: Final = 0.25
"""Weight of an impression without any liking; full liking adds 1."""


def write_item_states(
    folder: Path,
    item_features: sparse.csr_matrix | None,
    user_features: sparse.csr_matrix | None,
    n_items: int,
    n_users: int,
    size: int,
    tags: IntArray | None = None,
) -> ItemStates:
    """Learn the item embeddings and user features of the store at `folder` and write them there.

    Args:
        folder: episode store, which receives the file of item states.
        item_features: (n_items, F) as from `ucfrec.logs.features.encode_features`; None for none.
        user_features: (n_users, G) likewise.
        n_items: number of items of the store.
        n_users: number of users of the store.
        size: most dimensions of the item embeddings.
        tags: (n_items, T) as from `ucfrec.logs.features.item_tags`; None for none.

    Returns:
        The item states, as written.

    Raises:
        InputError: the rewards of the training split are all equal.
    """
    store = EpisodeStore.open(folder).split("train")
    episodes, steps = store.all_steps()
    items = store.step_values(schema.ITEM, episodes, steps).astype(np.int64)
    rewards = store.step_values(schema.REWARD, episodes, steps).astype(np.float64)
    users = store.episode_values(schema.USER)[episodes]
    low = float(rewards.min())
    high = min(float(rewards.max()), float(rewards.mean() + 2 * rewards.std()))
    if not low < high:
        raise InputError(
            f"all {len(rewards)} rewards of the training split equal {low}; choose another reward"
        )
    liking = np.clip((rewards - low) / (high - low), 0, 1)
    embeddings = item_embeddings(users, items, liking, n_items, item_features, size)
    user_vectors = np.zeros((n_users, 0), dtype=np.float32)
    if user_features is not None:
        known = np.unique(users)
        user_vectors = _reduced(user_features, known, USER_SIZE)
        spread = user_vectors[known].std(axis=0)
        user_vectors /= np.where(spread > 0, spread, 1)
    states = ItemStates(torch.from_numpy(embeddings), torch.from_numpy(user_vectors), low, high)
    if tags is not None:
        states = replace(states, tags=torch.from_numpy(tags))
    states.save(folder / ITEM_STATES)
    return states


def item_embeddings(
    users: IntArray,
    items: IntArray,
    liking: npt.NDArray[np.float64],
    n_items: int,
    features: sparse.csr_matrix | None = None,
    size: int = 32,
) -> FloatArray:
    """Embed items by co-occurrence in users' histories and by their features.

    The co-occurrence part is the truncated SVD of the user × item matrix of exposure and liking,
    scaled to unit rows. It is averaged with the prediction of a ridge regression from the item's
    features (zero without features), whose weight grows the fewer times the item was shown: an item
    never shown has the prediction alone. With features, up to half of the dimensions are the
    features themselves, reduced by SVD. No embedding has a norm above 1.

    Args:
        users: (M,) user of each training step.
        items: (M,) item shown, 0 to n_items − 1.
        liking: (M,) reward scaled to [0, 1].
        n_items: number of items.
        features: (n_items, F); None for none.
        size: largest D.

    Returns:
        (n_items, D) float32; D is below `size` if there are few users, items or features.
    """
    trained, columns, counts = np.unique(items, return_inverse=True, return_counts=True)
    content = None if features is None else _unit_rows(_reduced(features, trained, size // 2))
    remaining = size if content is None else max(size - content.shape[1], 1)
    cooccurrence = _cooccurrence(users, columns, EXPOSURE + liking, remaining)
    trust = (counts / (counts + PRIOR_COUNT))[:, None]
    combined = np.zeros((n_items, cooccurrence.shape[1]))
    if features is not None:
        combined = _predicted(features, trained, cooccurrence, counts)
    combined[trained] = trust * cooccurrence + (1 - trust) * combined[trained]
    if content is None:
        return np.asarray(combined, dtype=np.float32)
    return np.asarray(np.hstack([combined, content]) / np.sqrt(2), dtype=np.float32)


def _cooccurrence(
    users: IntArray, columns: IntArray, weights: npt.NDArray[np.float64], size: int
) -> npt.NDArray[np.float64]:
    """(trained items, ≤ size) unit rows from the SVD of the weighted user × item matrix."""
    _, rows = np.unique(users, return_inverse=True)
    matrix = sparse.coo_matrix((weights, (rows, columns))).tocsr()
    matrix.data = np.log1p(matrix.data)
    by_item = np.sqrt(np.asarray(matrix.sum(axis=0)).ravel())
    by_user = np.sqrt(np.asarray(matrix.sum(axis=1)).ravel())
    balanced = sparse.diags(1 / by_user) @ matrix @ sparse.diags(1 / by_item)
    rank = min(size + 1, *balanced.shape)
    require_blas_memory()
    _, strength, directions = randomized_svd(balanced, rank, random_state=0)
    # One direction holds only the popularity of items (the trivial axis of correspondence
    # analysis) and has the largest singular value; it would dominate the others.
    popular = by_item / np.linalg.norm(by_item)
    directions = directions - np.outer(directions @ popular, popular)
    nontrivial = np.delete(np.arange(rank), np.linalg.norm(directions, axis=1).argmin())
    nontrivial = nontrivial if rank > 1 else np.arange(1)
    return _unit_rows((np.sqrt(strength)[nontrivial, None] * directions[nontrivial]).T)


def _predicted(
    features: sparse.csr_matrix,
    trained: IntArray,
    cooccurrence: npt.NDArray[np.float64],
    counts: IntArray,
) -> npt.NDArray[np.float64]:
    """(n_items, size) co-occurrence part predicted from features, by ridge regression."""
    axes = _axes(features[trained], CONTENT_RANK)
    known = np.asarray(features[trained] @ axes, dtype=np.float64)
    weights = counts / (counts + PRIOR_COUNT)
    gram = known.T @ (weights[:, None] * known) + RIDGE * np.eye(known.shape[1])
    slopes = np.linalg.solve(gram, known.T @ (weights[:, None] * cooccurrence))
    # Sparse times dense is computed row by row, so an item's result does not depend on other items.
    return np.asarray(features @ (axes @ slopes), dtype=np.float64)


def _reduced(features: sparse.csr_matrix, known: IntArray, size: int) -> FloatArray:
    """(n, ≤ size) features on the singular axes of the rows `known`, centred on their mean."""
    rows: npt.NDArray[Any] = np.asarray(features @ _axes(features[known], max(size, 1)))
    rows -= rows[known].mean(axis=0)
    # A row without any feature is at the mean.
    rows[np.diff(features.indptr) == 0] = 0
    return np.asarray(rows, dtype=np.float32)


def _axes(known: sparse.csr_matrix, size: int) -> npt.NDArray[Any]:
    """(F, D ≤ `size`) right singular vectors of the rows; the identity if F ≤ `size`."""
    if known.shape[1] <= size:
        return np.eye(known.shape[1])
    require_blas_memory()
    _, _, directions = randomized_svd(known, min(size, known.shape[0]), random_state=0)
    return np.asarray(directions.T)


def _unit_rows(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(norms > 0, norms, 1)
