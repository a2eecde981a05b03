"""The table of `ucfrec rank`: policies of one store and baselines, on the same later steps."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ucfrec.arrays import Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.evaluation.ranking import MEASURES, Period, compare, rank_steps, rankers_named
from ucfrec.evaluation.ranking_baselines import PolicyRanker, RewardRanker, baselines
from ucfrec.provenance import provenance
from ucfrec.runs.record import store_of
from ucfrec.runs.trained_policy import TrainedPolicy


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


def training_store(trained: TrainedPolicy) -> EpisodeStore | None:
    """The store that the run was trained on; None where it is gone or changed."""
    return store_of(trained.folder, trained.record)


def ranking_rows(
    policies: Sequence[PolicyRanker],
    trained: TrainedPolicy,
    train: EpisodeStore | None,
    later: EpisodeStore,
    users: Array,
    k: int,
    seed: int,
) -> list[dict[str, Any]]:
    """One row for every policy and baseline.

    Each measure of `ucfrec.evaluation.ranking.MEASURES` has beside it `<measure>_interval` and
    `<measure>_difference`: the value less the first policy's, with its interval. Rows of policies
    have their `decision_rule`, and its hash as `rule`.

    Args:
        policies: at least one; the first is the reference of the differences.
        trained: any of their runs, for the counts of the training rows and the reward model.
        train: the store of those rows; None leaves out item-kNN and ALS.
        later: the steps to rank.
        users: (E,) identifier of the user of each episode of `later`.
        k: items that are recommended at a step.
        seed: of the resampled users and of `random`.
    """
    counts = trained.counts
    assert counts is not None
    fitted_on = None if train is None else train.split("train")
    model = [] if trained.reward_model is None else [RewardRanker(trained.decider())]
    named = rankers_named([*policies, *model, *baselines(counts, fitted_on, seed)])
    k = min(k, len(counts.shown))
    period = Period.of(later, np.asarray(users))
    ranked = {name: rank_steps(ranker, later, k, period.users) for name, ranker in named.items()}
    reference = next(iter(named))
    shared = {
        "k": k,
        "steps": len(period.items),
        "users": len(np.unique(period.users)),
        "reference": reference,
        "seed": seed,
        "fingerprint": later.record.fingerprint,
        "train_fingerprint": trained.record.fingerprint,
        **provenance(),
    }
    rules = dict(zip(named, (policy.rule for policy in policies), strict=False))
    rows = []
    for one in compare(period, ranked, k, reference, seed):
        row: dict[str, Any] = {"policy": one.name, "coverage": one.coverage}
        if rule := rules.get(one.name):
            row |= {"rule": rule.hash, "decision_rule": rule.as_dict()}
        for name in MEASURES:
            row[name] = one.values[name]
            row[f"{name}_interval"] = list(one.intervals[name])
            row[f"{name}_difference"] = list(one.differences[name])
        rows.append(row | shared)
    return rows
