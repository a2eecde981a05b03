"""What a trained policy must beat at ranking: simple rankers fitted on the same training rows."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Final

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.item_counts import TrainingCounts, liked_steps
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.ranking import Ranker, Steps
from ucfrec.policies.item_knn import ItemKNNConfig, ItemKNNPolicy
from ucfrec.runs.trained_policy import TrainedPolicy

_PRIOR: Final = 10.0
"""Impressions at the mean rate that every item is credited with before its own are counted."""
_KNN_HISTORY: Final = 20
_ALS_FACTORS: Final = 32


class PolicyRanker:
    """A trained policy's probabilities, given a target return."""

    def __init__(self, trained: TrainedPolicy, target_return: float, name: str) -> None:
        self.name, self._trained, self._target = name, trained, target_return

    def scores(self, steps: Steps) -> Tensor:
        """(B, n_items) log-probabilities; earlier rewards of the session lower the target."""
        windows = steps.windows(self._trained.policy.config.context)
        more = torch.from_numpy(self._target - steps.store.returns[steps.episodes])
        return self._trained.log_probabilities(windows, more.unsqueeze(1))


@dataclass(frozen=True)
class SameForAll:
    """One score an item, whoever the user is."""

    name: str
    items: Tensor
    """(n_items,)."""

    def scores(self, steps: Steps) -> Tensor:
        """(1, n_items)."""
        return self.items.unsqueeze(0)


class Random:
    """Every item equally likely."""

    name = "random"

    def __init__(self, n_items: int, seed: int) -> None:
        self._n_items, self._generator = n_items, torch.Generator().manual_seed(seed)

    def scores(self, steps: Steps) -> Tensor:
        """(B, n_items) uniform."""
        return torch.rand(len(steps.steps), self._n_items, generator=self._generator)


class ItemNeighbours:
    """Cosine to what the session so far liked, popularity where it liked nothing."""

    name = "item-knn"

    def __init__(self, train: EpisodeStore, popularity: Tensor) -> None:
        embeddings = train.item_states.embeddings
        sizes = {
            "state": train.state_size,
            "action": embeddings.shape[1],
            "items": len(embeddings),
        }
        self._knn = ItemKNNPolicy(ItemKNNConfig(context=_KNN_HISTORY, dim=1), sizes)
        self._knn.start_from(train)
        self._tie_break = 1e-6 * popularity / popularity.max()

    def scores(self, steps: Steps) -> Tensor:
        """(B, n_items)."""
        windows = steps.windows(_KNN_HISTORY)
        return self._knn.features(windows)[:, -1] + self._tie_break


class MatrixFactorisation:
    """Implicit-feedback ALS (Hu et al., 2008) of the package `implicit` on users' liked items."""

    name = "als"

    def __init__(self, train: EpisodeStore, popularity: Tensor, seed: int) -> None:
        from implicit.als import AlternatingLeastSquares
        from threadpoolctl import threadpool_limits

        episodes, steps = train.all_steps()
        users = train.episode_values(schema.USER).astype(np.int64)[episodes]
        items = train.step_values(schema.ITEM, episodes, steps)
        liked = liked_steps(train, episodes, steps).astype(np.float32)
        shape = (int(users.max()) + 1, len(popularity))
        matrix = sparse.csr_matrix((liked, (users, items)), shape=shape)
        matrix.eliminate_zeros()
        model = AlternatingLeastSquares(
            factors=_ALS_FACTORS, random_state=seed, num_threads=1, use_gpu=False
        )
        with threadpool_limits(1, "blas"):
            model.fit(matrix, show_progress=False)
        # The last row stands for users without a liked item: popularity decides.
        factors = np.vstack([np.asarray(model.user_factors), np.zeros(_ALS_FACTORS)])
        factors[:-1][np.diff(matrix.indptr) == 0] = 0.0
        self._users = torch.from_numpy(factors.astype(np.float32))
        self._items = torch.from_numpy(np.array(model.item_factors, dtype=np.float32))
        self._tie_break = 1e-6 * popularity / popularity.max()

    def scores(self, steps: Steps) -> Tensor:
        """(B, n_items)."""
        known = np.where(steps.users < len(self._users) - 1, steps.users, -1)
        return self._users[torch.from_numpy(known)] @ self._items.T + self._tie_break


def baselines(counts: TrainingCounts, train: EpisodeStore | None, seed: int) -> list[Ranker]:
    """Random, most shown, most clicked, item click rate; item-kNN and, where the package `implicit`
    is installed (extra `rank`), ALS.

    Args:
        counts: of the training rows.
        train: the training episodes; None where the store is not at hand, which leaves out item-kNN
            and ALS.
    """
    shown, liked = counts.shown.double(), counts.liked.double()
    mean = float(liked.sum() / shown.sum())
    rate = (liked + _PRIOR * mean) / (shown + _PRIOR)
    found: list[Ranker] = [
        Random(len(shown), seed),
        SameForAll("most shown", shown),
        SameForAll("most clicked", liked),
        SameForAll("item click rate", rate),
    ]
    if train is not None:
        found.append(ItemNeighbours(train, shown.float()))
        if find_spec("implicit") is not None:
            found.append(MatrixFactorisation(train, shown.float(), seed))
    return found
