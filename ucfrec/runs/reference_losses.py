"""Losses to compare a policy of items with: what it takes no learning to reach."""

import math

import torch

from ucfrec import schema
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import EpisodeStore


def reference_losses(counts: TrainingCounts, validation: EpisodeStore) -> dict[str, float]:
    """Mean negative log-likelihood, in nats, of the items of all held-out steps.

    Args:
        counts: of the training steps.
        validation: the held-out episodes; one at least.

    Returns:
        `uniform`: all items equally probable. `popularity`: probable by their share of the training
        steps, each counted once more, which is where `ItemHead` begins.
    """
    items = torch.from_numpy(validation.step_values(schema.ITEM, *validation.all_steps())).long()
    seen = counts.shown + 1
    log_shares = torch.log(seen / seen.sum())
    return {
        "uniform": math.log(len(counts.shown)),
        "popularity": -float(log_shares[items].double().mean()),
    }
