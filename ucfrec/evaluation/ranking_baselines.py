"""Trained policies as rankers, and simple baselines fitted on the same training rows."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer, logged_history, logged_scores
from ucfrec.episodes.item_counts import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.evaluation.liked import Liked
from ucfrec.evaluation.ranking import Ranker, Steps
from ucfrec.policies.popular import (
    ItemRatePolicy,
    RecentClicksPolicy,
    RecentRatePolicy,
    decayed_counts,
)
from ucfrec.runs.config import resolve_config
from ucfrec.runs.policy_fit import fit_policy
from ucfrec.runs.start import new_policy
from ucfrec.runs.trained_policy import TrainedPolicy

_ALS_FACTORS: Final = 32
_BPR: Final = {
    **{"train.steps": 300, "train.batch_size": 256, "train.learning_rate": 0.01},
    **{"train.warmup_steps": 0, "train.average": 0.0, "policy.dim": 32},
}
_FITTED: Final[Mapping[str, tuple[str, Mapping[str, Any]]]] = {
    "item-knn": ("item-knn", {}),
    "boosted clicks": ("boosted", {}),
    "bpr": ("bpr", _BPR),
}
"""Policies and settings of the baselines that learn from single rows, by their names in rows."""


class PolicyRanker:
    """Ranks items as a trained policy does under its decision rule, before anything is drawn."""

    def __init__(self, trained: TrainedPolicy, rule: DecisionRule | None = None) -> None:
        self.name, self.trained, self._scorer = trained.name, trained, trained.scorer(rule)
        self.rule = self._scorer.rule

    def scores(self, steps: Steps) -> Tensor:
        """Log-probabilities at temperature 1 (B, n_items); see `Scorer.scores`."""
        at = steps.store, steps.episodes, steps.steps
        scores = logged_scores(self._scorer, *at, steps.left_out)
        return scores.log_softmax(-1).nan_to_num(nan=-torch.inf, neginf=-torch.inf)


@dataclass(frozen=True)
class RewardRanker:
    """Ranks items by the run's reward model alone."""

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


class FittedPolicy:
    """Ranks items as a policy that is fitted for the comparison, with settings of its own."""

    def __init__(
        self,
        name: str,
        train: EpisodeStore,
        seed: int,
        held_out: tuple[EpisodeStore, EpisodeStore] | None = None,
    ) -> None:
        """Args:
        name: of the ranker, one of those in `_FITTED`.
        train: the episodes that are fitted.
        held_out: training and validation episodes that choose what is chosen on held-out rows.
        """
        self.name, (policy, settings) = name, _FITTED[name]
        settings = {"policy.context": 21, "policy.dim": 1, **settings}
        config = resolve_config(policy, None, settings, seed)
        with TemporaryDirectory() as scratch:
            folder, choice = Path(scratch), None
            self._policy = new_policy(train, config)
            if self._policy.chosen and held_out is not None:
                first = new_policy(held_out[0], config)
                fit_policy(first, *held_out, folder / "first", config)
                choice = folder / "first" / "policy" / "best.safetensors"
            fit_policy(self._policy, train, None, folder / "whole", config, choice)

    def scores(self, steps: Steps) -> Tensor:
        """Scores (B, n_items), as the policy gives them."""
        return self._policy.act(steps.windows(self._policy.config.context))


class MatrixFactorisation:
    """Factors of users and items from the users' liked items: ALS (Hu et al., 2008).

    Needs the package `implicit`.
    """

    name = "als"

    def __init__(
        self,
        train: EpisodeStore,
        popularity: Tensor,
        seed: int,
        liked_of: Liked = liked_rewards,
    ) -> None:
        from implicit.als import AlternatingLeastSquares
        from threadpoolctl import threadpool_limits

        users = train.episode_values(schema.USER).astype(np.int64)[train.all_steps()[0]]
        items = train.column(schema.ITEM)
        liked = liked_of(train, train.column(schema.REWARD)).astype(np.float32)
        shape = (int(users.max()) + 1, len(popularity))
        matrix = sparse.csr_matrix((liked, (users, items)), shape=shape)
        matrix.eliminate_zeros()
        model = AlternatingLeastSquares(
            factors=_ALS_FACTORS, random_state=seed, num_threads=1, use_gpu=False
        )
        with threadpool_limits(1, "blas"):
            model.fit(matrix, show_progress=False)
        # The last row, zeros, is for unknown users; zeros leave only the popularity tie-break.
        of_users = np.asarray(model.user_factors)
        factors = np.vstack([of_users, np.zeros(of_users.shape[1])])
        factors[:-1][np.diff(matrix.indptr) == 0] = 0.0
        self._users = torch.from_numpy(factors.astype(np.float32))
        self._items = torch.from_numpy(np.array(model.item_factors, dtype=np.float32))
        self._tie_break = 1e-6 * popularity / popularity.max()

    def scores(self, steps: Steps) -> Tensor:
        """Scores (B, n_items)."""
        known = np.where(steps.users < len(self._users) - 1, steps.users, -1)
        return self._users[torch.from_numpy(known)] @ self._items.T + self._tie_break


def baselines(
    counts: TrainingCounts,
    train: EpisodeStore | None,
    seed: int,
    liked_of: Liked = liked_rewards,
    held_out: tuple[EpisodeStore, EpisodeStore] | None = None,
) -> list[Ranker]:
    """Baseline rankers: random, most shown, most clicked, item click rate, item-kNN, boosted
    clicks, ALS, BPR, and clicks and click rate with half-lives.

    ALS is included if the package `implicit` is installed (extra `rank`).

    Args:
        train: the training episodes; None if their store is unavailable, which excludes all that
            learn from single rows.
        seed: of the random scores, boosted clicks, ALS and BPR.
        liked_of: says which training steps were liked, for ALS and the half-lives; `counts` has its
            own, and item-kNN, boosted clicks and BPR those of the run.
        held_out: training and validation episodes that choose half-lives and the temperature of
            item-kNN; without them half-lives are left out.
    """
    shown, liked = counts.shown.double(), counts.liked.double()
    rankers: list[Ranker] = [
        Random(len(shown), seed),
        SameForAll("most shown", shown),
        SameForAll("most clicked", liked),
        SameForAll("item click rate", ItemRatePolicy.scores_of(counts)),
    ]
    if train is None:
        return rankers
    rankers += [FittedPolicy(name, train, seed, held_out) for name in _FITTED]
    if find_spec("implicit") is not None:
        rankers.insert(-1, MatrixFactorisation(train, shown.float(), seed, liked_of))
    if held_out is not None:
        for name, kind in (("clicks", RecentClicksPolicy), ("click rate", RecentRatePolicy)):
            hours = kind.best_half_life(*held_out, liked_of)
            scores = kind.scores_of(decayed_counts(train, hours, liked_of))
            rankers.append(SameForAll(f"recent {name}", scores.double()))
    return rankers
