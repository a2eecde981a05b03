"""Validation losses of two trivial predictors, to compare a policy of items with."""

import math

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
