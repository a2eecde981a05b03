"""Item embeddings and user features, learnt from the training window and nothing else."""

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

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]

PRIOR_COUNT: Final = 3.0
"""An item shown this often counts as much by its company as by its features."""
RIDGE: Final = 1.0
CONTENT_RANK: Final = 64
USER_SIZE: Final = 32
EXPOSURE: Final = 0.25
"""Weight of an impression that was not liked; a liked one has 1 more."""


def write_item_states(
    folder: Path,
    item_features: sparse.csr_matrix | None,
    user_features: sparse.csr_matrix | None,
    n_items: int,
    n_users: int,
    size: int,
) -> ItemStates:
    """Learn and write how states are made of the items of the store at `folder`.

    Args:
        item_features: (n_items, F) as `ucfrec.logs.features.encode_features` gives them.
        user_features: (n_users, G) likewise.
        size: of the embeddings, at most.

    Raises:
        InputError: the rewards of the training window are all equal.
    """
    store = EpisodeStore.open(folder).split("train")
    episodes, steps = store.all_steps()
    items = store.step_values(schema.ITEM, episodes, steps).astype(np.int64)
    rewards = store.step_values(schema.REWARD, episodes, steps).astype(np.float64)
    users = store.episode_values(schema.USER)[episodes]
    low = float(rewards.min())
    high = min(float(rewards.max()), float(rewards.mean() + 2 * rewards.std()))
    if not low < high:
        raise InputError(f"all {len(rewards)} rewards of the training window equal {low}")
    liking = np.clip((rewards - low) / (high - low), 0, 1)
    embeddings = item_embeddings(users, items, liking, n_items, item_features, size)
    about_users = np.zeros((n_users, 0), dtype=np.float32)
    if user_features is not None:
        known = np.unique(users)
        about_users = _reduced(user_features, known, USER_SIZE)
        spread = about_users[known].std(axis=0)
        about_users /= np.where(spread > 0, spread, 1)
    states = ItemStates(torch.from_numpy(embeddings), torch.from_numpy(about_users), low, high)
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
    """Embed items by the company they keep and by their features.

    The company part is the truncated SVD of the user × item matrix of exposure and liking, rows of
    unit length. It is drawn towards what a ridge regression expects of the item's features (zero
    without any), the more so the more seldom it was shown: a cold item is placed by its features
    alone. With features, half of the embedding describes them directly. No embedding is longer
    than 1.

    Args:
        users: (M,) user of each training step.
        items: (M,) item shown, 0 to n_items − 1.
        liking: (M,) in [0, 1].
        features: (n_items, F).
        size: D, at most.

    Returns:
        (n_items, D), D smaller than `size` where there are few users, items or features.
    """
    trained, columns, counts = np.unique(items, return_inverse=True, return_counts=True)
    content = None if features is None else _unit_rows(_reduced(features, trained, size // 2))
    room = size if content is None else max(size - content.shape[1], 1)
    company = _company(users, columns, EXPOSURE + liking, room)
    trust = (counts / (counts + PRIOR_COUNT))[:, None]
    placed = np.zeros((n_items, company.shape[1]))
    if features is not None:
        placed = _expected(features, trained, company, counts)
    placed[trained] = trust * company + (1 - trust) * placed[trained]
    if content is None:
        return np.asarray(placed, dtype=np.float32)
    return np.asarray(np.hstack([placed, content]) / np.sqrt(2), dtype=np.float32)


def _company(
    users: IntArray, columns: IntArray, weights: npt.NDArray[np.float64], size: int
) -> npt.NDArray[np.float64]:
    """Unit rows (items, size) from the SVD of the weighted user × item matrix."""
    _, rows = np.unique(users, return_inverse=True)
    matrix = sparse.coo_matrix((weights, (rows, columns))).tocsr()
    matrix.data = np.log1p(matrix.data)
    by_item = np.sqrt(np.asarray(matrix.sum(axis=0)).ravel())
    by_user = np.sqrt(np.asarray(matrix.sum(axis=1)).ravel())
    balanced = sparse.diags(1 / by_user) @ matrix @ sparse.diags(1 / by_item)
    rank = min(size + 1, *balanced.shape)
    _, strength, directions = randomized_svd(balanced, rank, random_state=0)
    # One direction only tells how popular an item is, alike for all users (correspondence analysis
    # calls it trivial): it would outshine the others.
    popular = by_item / np.linalg.norm(by_item)
    directions = directions - np.outer(directions @ popular, popular)
    telling = np.delete(np.arange(rank), np.linalg.norm(directions, axis=1).argmin())
    telling = telling if rank > 1 else np.arange(1)
    return _unit_rows((np.sqrt(strength)[telling, None] * directions[telling]).T)


def _expected(
    features: sparse.csr_matrix,
    trained: IntArray,
    company: npt.NDArray[np.float64],
    counts: IntArray,
) -> npt.NDArray[np.float64]:
    """Company part (n_items, size) that features let expect, by ridge regression on warm items."""
    axes = _axes(features[trained], CONTENT_RANK)
    known = np.asarray(features[trained] @ axes, dtype=np.float64)
    weights = counts / (counts + PRIOR_COUNT)
    gram = known.T @ (weights[:, None] * known) + RIDGE * np.eye(known.shape[1])
    slopes = np.linalg.solve(gram, known.T @ (weights[:, None] * company))
    # Sparse times dense goes row by row: other items in the catalogue change no bit of an item.
    return np.asarray(features @ (axes @ slopes), dtype=np.float64)


def _reduced(features: sparse.csr_matrix, known: IntArray, size: int) -> FloatArray:
    """Features in at most `size` dimensions, chosen and centred by the rows `known`."""
    rows: npt.NDArray[Any] = np.asarray(features @ _axes(features[known], max(size, 1)))
    rows -= rows[known].mean(axis=0)
    # Whoever has no features at all is nothing in particular.
    rows[np.diff(features.indptr) == 0] = 0
    return np.asarray(rows, dtype=np.float32)


def _axes(known: sparse.csr_matrix, size: int) -> npt.NDArray[Any]:
    """(F, D) principal axes of the rows, or the F features as they are if those are few."""
    if known.shape[1] <= size:
        return np.eye(known.shape[1])
    _, _, directions = randomized_svd(known, min(size, known.shape[0]), random_state=0)
    return np.asarray(directions.T)


def _unit_rows(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(norms > 0, norms, 1)
