"""Validation losses of two trivial predictors, to compare a policy of items with."""

import math
from collections.abc import Container, Mapping
from typing import Any

import torch

from ucfrec import schema
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import EpisodeStore


def reference_losses(counts: TrainingCounts, validation: EpisodeStore) -> dict[str, float]:
    """Mean negative log-likelihood (nats) of the logged items over all validation steps.

    Args:
        counts: item counts of the training steps.
        validation: validation episodes, at least one.

    Returns:
        `uniform`: the loss if all items are equally probable. `popularity`: the loss if an item's
        probability is its share of the training steps with one added to every count, which is how
        the bias of `ItemHead` is initialised.
    """
    items = torch.from_numpy(validation.column(schema.ITEM)).long()
    smoothed = counts.shown + 1
    log_shares = torch.log(smoothed / smoothed.sum())
    return {
        "uniform": math.log(len(counts.shown)),
        "popularity": -float(log_shares[items].double().mean()),
    }


def learned_nothing(record: Mapping[str, Any], logged: Container[str]) -> str:
    """A warning if a policy of items predicts logged choices no better than popularity does.

    Args:
        record: of the run (`run.json`).
        logged: names of the scalars that its training logged; without `action_loss` among them, the
            validation loss is not a log-likelihood of items and cannot be compared.

    Returns:
        What was found and what to do; empty if the policy learned something, has no validation
        loss (as a refit), or is not trained yet.
    """
    best = record.get("policy", {}).get("best_validation")
    popularity = record.get("reference_losses", {}).get("popularity")
    if best is None or popularity is None or "action_loss" not in logged or not best >= popularity:
        return ""
    return (
        f"the best validation loss, {best:.4g}, is not below {popularity:.4g}, the loss of showing "
        "items by popularity: the policy learned nothing about users; train with more steps or a "
        "higher train.learning_rate, add features of users and items or more history, or use "
        "--policy item-rate"
    )
