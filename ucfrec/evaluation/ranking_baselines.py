"""Trained policies as rankers, and simple baselines fitted on the same training rows."""

from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Final

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer, logged_history, logged_scores
from ucfrec.episodes.item_counts import TrainingCounts, liked_steps
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.liked import Liked
from ucfrec.evaluation.ranking import Ranker, Steps
from ucfrec.policies.item_knn import ItemKNNConfig, ItemKNNPolicy
from ucfrec.policies.item_rate import liked_rates
from ucfrec.runs.trained_policy import TrainedPolicy

_KNN_HISTORY: Final = 20
"""Latest rows of the user that item-kNN reads."""
_ALS_FACTORS: Final = 32


class PolicyRanker:
    """Ranks items as a trained policy does under its decision rule, before anything is drawn."""

    def __init__(self, trained: TrainedPolicy, rule: DecisionRule | None, name: str) -> None:
        self.name, self.trained, self._scorer = name, trained, trained.scorer(rule)
        self.rule = self._scorer.rule

    def scores(self, steps: Steps) -> Tensor:
        """Log-probabilities at temperature 1 (B, n_items); see `Scorer.scores`."""
        at = steps.store, steps.episodes, steps.steps
        scores = logged_scores(self._scorer, *at, steps.left_out)
        return scores.log_softmax(-1).nan_to_num(nan=-torch.inf, neginf=-torch.inf)


@dataclass(frozen=True)
class RewardRanker:
    """Ranks items by the reward model that the run's decision rules reward weight by."""

    scorer: Scorer
    name: str = "reward model"

    def scores(self, steps: Steps) -> Tensor:
        """Predicted rewards (B, n_items), in the model's units, up to a constant per step."""
        history, _ = logged_history(self.scorer, steps.store, steps.episodes, steps.steps)
        return self.scorer.rewards(replace(history, users=torch.from_numpy(steps.users)))


@dataclass(frozen=True)
class SameForAll:
    """Ranks items by fixed scores, the same for all users."""

    name: str
    items: Tensor
    """(n_items,) score of each item."""

    def scores(self, steps: Steps) -> Tensor:
        """The fixed scores (1, n_items)."""
        return self.items.unsqueeze(0)


class Random:
    """Ranks items by uniform random scores."""

    name = "random"

    def __init__(self, n_items: int, seed: int) -> None:
        self._n_items, self._generator = n_items, torch.Generator().manual_seed(seed)

    def scores(self, steps: Steps) -> Tensor:
        """Scores (B, n_items), uniform in [0, 1)."""
        return torch.rand(len(steps.steps), self._n_items, generator=self._generator)


class ItemNeighbours:
    """Ranks items by their cosine to the user's latest rewarded items; ties go to the popular ones.

    See `ItemKNNPolicy`; the items are those of all the user's sessions, also before the log.
    """

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
        """Scores (B, n_items)."""
        recent = steps.rows.recent(steps.numbers, _KNN_HISTORY)
        return self._knn.similarity(*map(torch.from_numpy, recent)) + self._tie_break


class MatrixFactorisation:
    """Implicit-feedback ALS (Hu et al., 2008) on users' liked items.

    Needs the package `implicit`.
    """

    name = "als"

    def __init__(
        self, train: EpisodeStore, popularity: Tensor, seed: int, liked_of: Liked = liked_steps
    ) -> None:
        from implicit.als import AlternatingLeastSquares
        from threadpoolctl import threadpool_limits

        episodes, steps = train.all_steps()
        users = train.episode_values(schema.USER).astype(np.int64)[episodes]
        items = train.step_values(schema.ITEM, episodes, steps)
        liked = liked_of(train, episodes, steps).astype(np.float32)
        shape = (int(users.max()) + 1, len(popularity))
        matrix = sparse.csr_matrix((liked, (users, items)), shape=shape)
        matrix.eliminate_zeros()
        model = AlternatingLeastSquares(
            factors=_ALS_FACTORS, random_state=seed, num_threads=1, use_gpu=False
        )
        with threadpool_limits(1, "blas"):
            model.fit(matrix, show_progress=False)
        # The last row, zeros, is for unknown users; zeros leave only the popularity tie-break.
        factors = np.vstack([np.asarray(model.user_factors), np.zeros(_ALS_FACTORS)])
        factors[:-1][np.diff(matrix.indptr) == 0] = 0.0
        self._users = torch.from_numpy(factors.astype(np.float32))
        self._items = torch.from_numpy(np.array(model.item_factors, dtype=np.float32))
        self._tie_break = 1e-6 * popularity / popularity.max()

    def scores(self, steps: Steps) -> Tensor:
        """Scores (B, n_items)."""
        known = np.where(steps.users < len(self._users) - 1, steps.users, -1)
        return self._users[torch.from_numpy(known)] @ self._items.T + self._tie_break


def baselines(
    counts: TrainingCounts, train: EpisodeStore | None, seed: int, liked_of: Liked = liked_steps
) -> list[Ranker]:
    """Baseline rankers: random, most shown, most clicked, item click rate, item-kNN and ALS.

    ALS is included if the package `implicit` is installed (extra `rank`).

    Args:
        counts: item counts of the training rows.
        train: the training episodes; None if their store is unavailable, which excludes item-kNN
            and ALS.
        seed: of the random scores and of ALS.
        liked_of: says which training steps were liked, for ALS; `counts` has its own.
    """
    shown, liked = counts.shown.double(), counts.liked.double()
    rankers: list[Ranker] = [
        Random(len(shown), seed),
        SameForAll("most shown", shown),
        SameForAll("most clicked", liked),
        SameForAll("item click rate", liked_rates(counts)),
    ]
    if train is not None:
        rankers.append(ItemNeighbours(train, shown.float()))
        if find_spec("implicit") is not None:
            rankers.append(MatrixFactorisation(train, shown.float(), seed, liked_of))
    return rankers
