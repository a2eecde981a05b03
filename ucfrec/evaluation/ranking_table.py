"""The table of `ucfrec rank`: policies of one store and baselines, on the same later steps."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ucfrec.arrays import Array
from ucfrec.episodes.states import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.ranking import (
    MEASURES,
    Compared,
    Later,
    Liked,
    LikedByRange,
    Period,
    Ranker,
    compare,
    name_rankers,
    rank_steps,
)
from ucfrec.evaluation.ranking_baselines import (
    PolicyRanker,
    RewardRanker,
    baselines,
    recent_rankers,
)
from ucfrec.provenance import config_hash, provenance
from ucfrec.results.rows import ResultRow
from ucfrec.runs.trained_policy import TrainedPolicy

SUITE: Final = "rank"
"""Suite of the rows."""
METRIC: Final = "hit_rate_liked"
_OTHERWISE: Final = "hit_rate_shown"
"""Metric of rows on logs in which nothing is liked."""


def require_one_catalogue(trained: Sequence[TrainedPolicy]) -> None:
    """Refuse runs that cannot be ranked side by side.

    Raises:
        InputError: the actions of a policy are vectors, or two were trained on different stores.
    """
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
    liked: Liked | None = None,
) -> list[ResultRow]:
    """One row for every policy and baseline.

    The details have, by measure of `ucfrec.evaluation.ranking.MEASURES`, `intervals` and
    `differences`: the value less the first policy's, with its interval. Rows of policies have
    their `decision_rule`, and its hash as `rule`.

    Args:
        policies: at least one; the first is the reference of the differences.
        trained: any of their runs, for the counts of the training rows and the reward model.
        train: the store of those rows; None excludes item-kNN and ALS.
        users: (E,) identifier of the user of each of its episodes.
        k: items that are recommended at a step.
        seed: of the resampled users and of `random`.
        liked: which steps were liked; None for the run's own definition. Without `train`, "most
            clicked" and "item click rate" keep the run's own.
    """
    rankers, liked = _rankers(policies, trained, train, seed, liked)
    assert trained.counts is not None
    k = min(k, len(trained.counts.shown))
    period = Period.of(later.store, np.asarray(users), liked)
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
            "liked": str(liked),
            "liked_share": float(period.liked.mean()),
        },
        "details": {"train_fingerprint": trained.record.fingerprint},
        **provenance(),
    }
    return [
        _row(compared, policy_rankers.get(compared.name), shared)
        for compared in compare(period, ranked, reference, seed)
    ]


def _rankers(
    policies: Sequence[PolicyRanker],
    trained: TrainedPolicy,
    train: EpisodeStore | None,
    seed: int,
    liked: Liked | None,
) -> tuple[dict[str, Ranker], Liked]:
    """The policies, the reward model and the baselines by name; and which steps were liked."""
    counts = trained.counts
    assert counts is not None
    assert trained.item_states is not None
    whole = trained.record.refit_of is not None
    fitted_on = train if train is None or whole else train.split("train")
    if liked is not None and fitted_on is not None:
        counts = TrainingCounts.of(fitted_on, liked)
    liked = liked or LikedByRange(trained.item_states)
    model = [] if trained.reward_model is None else [RewardRanker(trained.scorer())]
    others = baselines(counts, fitted_on, seed, liked)
    if train is not None and fitted_on is not None:
        others += recent_rankers(fitted_on, train, liked)
    return name_rankers([*policies, *model, *others]), liked


def _row(compared: Compared, policy: PolicyRanker | None, shared: Mapping[str, Any]) -> ResultRow:
    """The row of one ranker; `policy` is the ranker if it is a trained policy."""
    row = ResultRow(method=compared.name, policy=compared.name, **shared)
    if policy is not None:
        rule, record = policy.rule, policy.trained.record
        row = row.extended(
            {"decision_rule": rule.as_dict()},
            rule=rule.hash,
            policy=record.config.policy_name,
            training_seed=record.seed,
            config_hash=config_hash(record.settings),
        )
    metric = METRIC if math.isfinite(compared.values[METRIC]) else _OTHERWISE
    low, high = compared.intervals[metric]
    interval = (low, high) if math.isfinite(low) and math.isfinite(high) else None
    measured = {
        **{name: compared.values[name] for name in MEASURES},
        "coverage": compared.coverage,
        "intervals": compared.intervals,
        "differences": compared.differences,
    }
    return row.extended(measured, interval=interval, metric=metric)
