"""The table of `ucfrec rank`: policies of one store, and baselines that are fitted on the same
training rows, on the same later steps."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import logged_scores, sessions_before
from ucfrec.arrays import Array
from ucfrec.episodes.states import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.ranking import (
    Later,
    LikedExpression,
    Period,
    Ranker,
    Steps,
    compare,
    describe_liked,
    name_rankers,
    rank_steps,
)
from ucfrec.policies.baselines import (
    ItemKNNConfig,
    ItemKNNPolicy,
    LikedOf,
    RecentClicksPolicy,
    RecentRatePolicy,
    shrink_rates,
)
from ucfrec.provenance import config_hash, provenance
from ucfrec.results.rows import ResultRow
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy, policy_sizes
from ucfrec.runs.trained_policy import TrainedPolicy

SUITE = "rank"
"""Suite of the rows."""
METRIC = "hit_rate_liked"
_OTHERWISE = "hit_rate_shown"
"""Metric of rows on logs in which nothing is liked."""
_KNN_HISTORY = 20
"""Latest rows of the user that item-kNN reads."""
_ALS_FACTORS = 32


class PolicyRanker:
    """Ranks items as a trained policy does under its decision rule, before anything is drawn."""

    def __init__(self, trained: TrainedPolicy, rule: DecisionRule | None = None) -> None:
        self.name, self.trained, self._scorer = trained.name, trained, trained.scorer(rule)
        self.rule = self._scorer.rule

    def scores(self, steps: Steps) -> Tensor:
        """Log-probabilities at temperature 1 (B, n_items); see `Scorer.scores`."""
        scores = logged_scores(
            self._scorer, steps.store, steps.episodes, steps.steps, steps.left_out
        )
        return scores.log_softmax(-1).nan_to_num(nan=-torch.inf, neginf=-torch.inf)


def same_for_all(items: Tensor) -> Ranker:
    """Ranks items by fixed scores (n_items,), the same for all users."""
    return lambda _: items.unsqueeze(0)


def neighbour_ranker(train: EpisodeStore, tie_break: Tensor) -> Ranker:
    """Ranks items by their cosine to the user's latest rewarded items, of all sessions, also before
    the log; ties go to the popular ones. See `ItemKNNPolicy`."""
    knn = ItemKNNPolicy(ItemKNNConfig(context=_KNN_HISTORY, dim=1), policy_sizes(train))
    knn.start_from(train)

    def scores(steps: Steps) -> Tensor:
        items, rewards = map(torch.from_numpy, steps.rows.recent(steps.numbers, _KNN_HISTORY))
        return knn.similarity(items, rewards) + tie_break

    return scores


def factor_rankers(
    train: EpisodeStore,
    tie_break: Tensor,
    seed: int,
    liked_of: LikedOf,
) -> Iterator[tuple[str, Ranker]]:
    """Rank items by factors of users and items from the users' liked items: ALS (Hu et al., 2008)
    and BPR (Rendle et al., 2009); needs the package `implicit`."""
    from implicit.als import AlternatingLeastSquares
    from implicit.bpr import BayesianPersonalizedRanking
    from threadpoolctl import threadpool_limits

    owners = train.episode_values(schema.USER)
    users = owners[train.all_steps()[0]]
    items = train.column(schema.ITEM)
    liked = liked_of(train, train.column(schema.REWARD)).astype(np.float32)
    shape = (int(users.max()) + 1, len(tie_break))
    matrix = sparse.csr_matrix((liked, (users, items)), shape=shape)
    matrix.eliminate_zeros()

    def scores(of_users: Tensor, of_items: Tensor, steps: Steps) -> Tensor:
        rows = np.where(steps.users < len(of_users) - 1, steps.users, -1)
        return of_users[torch.from_numpy(rows)] @ of_items.T + tie_break

    for name, kind in (("als", AlternatingLeastSquares), ("bpr", BayesianPersonalizedRanking)):
        model = kind(factors=_ALS_FACTORS, random_state=seed, num_threads=1, use_gpu=False)
        with threadpool_limits(1, "blas"):
            model.fit(matrix, show_progress=False)
        # The last row, zeros, is for unknown users; zeros leave only the popularity tie-break.
        factors = np.pad(np.asarray(model.user_factors), ((0, 1), (0, 0)))
        factors[:-1][np.diff(matrix.indptr) == 0] = 0.0
        of_users = torch.from_numpy(factors.astype(np.float32))
        of_items = torch.from_numpy(np.array(model.item_factors, dtype=np.float32))
        yield name, partial(scores, of_users, of_items)


def baselines(
    counts: TrainingCounts,
    train: EpisodeStore | None,
    seed: int,
    liked_of: LikedOf = liked_rewards,
    store: EpisodeStore | None = None,
) -> dict[str, Ranker]:
    """Baselines by name: random, most shown, most clicked, item click rate, item-kNN, boosted
    clicks, ALS and BPR if the package `implicit` is installed (extra `rank`), and clicks and click
    rate with half-lives, which the validation split of `store` chooses.

    Args:
        train: the training episodes; None if unavailable, which excludes what learns from rows.
        liked_of: which training steps were liked; `counts` has its own, boosted clicks the run's.
    """
    impressions, liked = counts.shown.double(), counts.liked.double()
    generator = torch.Generator().manual_seed(seed)
    rankers: dict[str, Ranker] = {
        "random": lambda steps: torch.rand(len(steps.steps), len(impressions), generator=generator),
        "most shown": same_for_all(impressions),
        "most clicked": same_for_all(liked),
        "item click rate": same_for_all(shrink_rates(counts)),
    }
    if train is not None:
        tie_break = 1e-6 * impressions.float() / impressions.float().max()
        rankers["item-knn"] = neighbour_ranker(train, tie_break)
        context = {"policy.context": _KNN_HISTORY + 1, "policy.dim": 1}
        boosted = new_policy(train, resolve_config("boosted", overrides=context, seed=seed))
        if solve := boosted.make_solver(train, None, Path(), seed):
            solve()

        def scores(steps: Steps) -> Tensor:
            windows = steps.store.windows(steps.episodes, steps.steps, _KNN_HISTORY + 1)
            return boosted.act(windows)

        rankers["boosted clicks"] = scores
        if find_spec("implicit") is not None:
            rankers |= factor_rankers(train, tie_break, seed, liked_of)
    if train is not None and store is not None and store.split("validation").n_episodes:
        first, validation = store.split("train"), store.split("validation")
        for name, kind in (("clicks", RecentClicksPolicy), ("click rate", RecentRatePolicy)):
            mixture = kind.choose_mixture(first, validation, liked_of)
            recent = kind.scores_of(train, mixture, liked_of)
            rankers[f"recent {name}"] = same_for_all(recent.double())
    return rankers


def require_one_catalogue(trained: Sequence[TrainedPolicy]) -> None:
    """Refuse runs that cannot be ranked side by side: policies of vectors, or of two stores."""
    for policy in trained:
        if policy.item_states is None or policy.counts is None:
            raise InputError(f"{policy.folder}: this policy has no items to rank")
        if policy.record.fingerprint != trained[0].record.fingerprint:
            raise InputError(
                f"{policy.folder} was trained on another store than {trained[0].folder}; rank "
                "them one by one"
            )


def ranking_rows(
    policies: Sequence[PolicyRanker],
    trained: TrainedPolicy,
    train: EpisodeStore | None,
    later: Later,
    users: Array,
    k: int,
    seed: int,
    liked: LikedExpression | None = None,
) -> list[ResultRow]:
    """One row for every policy and baseline, with the `MEASURES`, their `intervals` and
    `differences`: the value less the first policy's, with its interval.

    Args:
        policies: at least one; the first is the reference of the differences.
        trained: any of their runs, for the counts of the training rows and the reward model.
        train: the store of those rows; None excludes what learns from them.
        users: (E,) identifier of the user of each episode of `later`.
        liked: which steps were liked; None for the run's own definition, which "most clicked" and
            "item click rate" keep without `train`.
    """
    counts, fitted_on = trained.counts, train
    liked_of = liked or liked_rewards
    assert counts is not None
    assert trained.item_states is not None
    if train is not None and trained.record.refit_of is None:
        fitted_on = train.split("train")
    if liked is not None and fitted_on is not None:
        counts = TrainingCounts.of(fitted_on, liked)
    unnamed: list[tuple[str, Ranker]] = [(policy.name, policy.scores) for policy in policies]
    for policy in policies:
        if policy.rule.reward_weight and policy.rule.policy_weight:
            alone = replace(policy.rule, reward_weight=0.0, lookahead=0.0)
            without = PolicyRanker(policy.trained, alone)
            unnamed.append((f"{policy.name}, weight 0", without.scores))
    if trained.reward_model is not None:
        scorer = trained.scorer()

        def scores(steps: Steps) -> Tensor:
            sessions = sessions_before(scorer, steps.store, steps.episodes, steps.steps)
            return scorer.rewards(replace(sessions, users=torch.from_numpy(steps.users)))

        unnamed.append(("reward model", scores))
    unnamed += baselines(counts, fitted_on, seed, liked_of, train).items()
    rankers = name_rankers(unnamed)
    k = min(k, len(counts.shown))
    period = Period.of(later.store, np.asarray(users), liked_of)
    ranked = {name: rank_steps(ranker, later, k) for name, ranker in rankers.items()}
    reference = next(iter(rankers))
    policy_rankers = dict(zip(rankers, policies, strict=False))
    shared: dict[str, Any] = {
        "suite": SUITE,
        "table": SUITE,
        "task": "logs",
        "evaluation_seed": seed,
        "metric": METRIC,
        "metrics": {},
        "data_fingerprint": later.store.record.fingerprint,
        "conditions": {
            "k": k,
            "steps": len(period.items),
            "users": len(np.unique(period.users)),
            "reference": reference,
            "filter_seen": later.filter_seen,
            "out_of_reach": later.share_out_of_reach(),
            "items_without_rows": float((counts.shown[period.items] == 0).float().mean()),
            "users_without_rows": _share_of_new_users(later.store, fitted_on),
            "liked": str(liked or describe_liked(trained.item_states)),
            "liked_share": float(period.liked.mean()),
        },
        "details": {"train_fingerprint": trained.record.fingerprint},
        **provenance(),
    }
    return [
        _row(name, measured, policy_rankers.get(name), shared)
        for name, measured in compare(period, ranked, reference, seed).items()
    ]


def _share_of_new_users(later: EpisodeStore, train: EpisodeStore | None) -> float | None:
    """Share of steps of users without training rows."""
    if train is None:
        return None
    is_known = np.isin(later.episode_values(schema.USER), train.episode_values(schema.USER))
    return float(later.lengths[~is_known].sum() / later.n_steps)


def _row(
    name: str,
    measured: Mapping[str, Any],
    policy: PolicyRanker | None,
    shared: Mapping[str, Any],
) -> ResultRow:
    """The row of one ranker; `policy` is the ranker if it is a trained policy."""
    row = ResultRow(method=name, policy=name, **shared)
    if policy is not None:
        rule, record = policy.rule, policy.trained.record
        row = row.extended(
            {"decision_rule": rule.as_dict()},
            rule=rule.hash,
            policy=record.config.policy_name,
            training_seed=record.seed,
            config_hash=config_hash(record.settings),
        )
    metric = METRIC if math.isfinite(measured[METRIC]) else _OTHERWISE
    low, high = measured["intervals"][metric]
    interval = (low, high) if math.isfinite(low + high) else None
    return row.extended(measured, interval=interval, metric=metric)
