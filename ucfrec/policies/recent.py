"""Clicks and click rate that forget: baselines for logs whose items come and go."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray
from ucfrec.episodes.item_counts import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.policies.base import PolicyConfig
from ucfrec.policies.item_rate import ItemRatePolicy, liked_rates
from ucfrec.settings import settings_table

HALF_LIVES: Final = (3.0, 6.0, 12.0, 24.0, 48.0, 96.0, 192.0, 384.0, 768.0, math.inf)
"""Hours after which a row counts half; those that are tried."""
_HOUR_MS: Final = 3_600_000
_SMOOTHING: Final = 1.0
"""Clicks that are added to all items together."""

LikedOf = Callable[[EpisodeStore, Array], BoolArray]


@settings_table("policy")
class RecentConfig(PolicyConfig):
    """Settings of clicks and click rate with a half-life."""

    half_life: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Hours after which a training row counts half; 0 chooses them on the validation rows."""


class RecentRatePolicy(ItemRatePolicy):
    """`ItemRatePolicy` whose training rows count less the older they are.

    A row that is h half-lives older than the last training row counts 2^−h. The half-life is the
    one of `HALF_LIVES` whose rates have the lowest log loss of likes on the validation rows.
    """

    Config = RecentConfig
    chosen = ("half_life",)
    config: RecentConfig
    half_life: Tensor

    def __init__(self, config: RecentConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.register_buffer("half_life", torch.tensor(config.half_life or math.inf))

    def closed_form(
        self, train: EpisodeStore, validation: EpisodeStore | None, folder: Path, seed: int
    ) -> Callable[[], None]:
        """Chooses the half-life and sets the biases of the head.

        Raises:
            InputError: actions are vectors.
        """
        bias = self.item_bias()

        def solve() -> None:
            if validation is not None and not self.config.half_life:
                self.half_life.fill_(self.best(train, validation))
            counts = decayed_counts(train, float(self.half_life))
            with torch.no_grad():
                bias.copy_(self.scores_of(counts))

        return solve

    @classmethod
    def scores_of(cls, counts: TrainingCounts) -> Tensor:
        """Log-odds (n_items,) of the rate of likes."""
        return torch.logit(liked_rates(counts))

    @classmethod
    def loss_of(cls, counts: TrainingCounts, held_out: TrainingCounts) -> float:
        """Mean loss (nats) of the counts' scores on held-out counts."""
        rates, likes = torch.sigmoid(cls.scores_of(counts).double()), held_out.liked.double()
        losses = likes * rates.log() + (held_out.shown - likes) * torch.log1p(-rates)
        return -float(losses.sum() / held_out.shown.sum())

    @classmethod
    def best(
        cls, train: EpisodeStore, validation: EpisodeStore, liked_of: LikedOf = liked_rewards
    ) -> float:
        """The half-life (hours) with the lowest loss on validation episodes."""
        held_out = TrainingCounts.of(validation, liked_of)
        losses = [
            cls.loss_of(decayed_counts(train, hours, liked_of), held_out) for hours in HALF_LIVES
        ]
        finite = [loss if math.isfinite(loss) else math.inf for loss in losses]
        # Of equal ones, the longest.
        return HALF_LIVES[len(losses) - 1 - int(np.argmin(finite[::-1]))]


class RecentClicksPolicy(RecentRatePolicy):
    """Scores items by their share of likes in the training rows, of which older ones count less.

    The half-life has the lowest log loss of the items liked in the validation rows.
    """

    @classmethod
    def scores_of(cls, counts: TrainingCounts) -> Tensor:
        """Logarithms (n_items,) of the items' shares of likes."""
        likes = counts.liked.double() + _SMOOTHING / len(counts.liked)
        return torch.log(likes / likes.sum()).float()

    @classmethod
    def loss_of(cls, counts: TrainingCounts, held_out: TrainingCounts) -> float:
        """Mean loss (nats) of the items liked in held-out counts."""
        likes = held_out.liked.double()
        return -float((likes * cls.scores_of(counts)).sum() / likes.sum())


def decayed_counts(
    train: EpisodeStore, half_life: float, liked_of: LikedOf = liked_rewards
) -> TrainingCounts:
    """Counts of shown and liked steps, float64, in which older steps count less.

    Args:
        train: a view of a store of items.
        half_life: hours; infinite, or without times in the store, all steps count alike.
    """
    n_items = len(train.item_states.embeddings)
    shown, liked = np.zeros(n_items), np.zeros(n_items)
    timed = schema.TIMESTAMP in train.record.columns and math.isfinite(half_life)
    last = int(train.column(schema.TIMESTAMP).max()) if timed else 0
    names = (schema.ITEM, schema.REWARD, *([schema.TIMESTAMP] if timed else []))
    for items, rewards, *times in train.column_batches(*names):
        weights = np.ones(len(items))
        if timed:
            weights = np.exp2(-(last - times[0].astype(np.int64)) / (half_life * _HOUR_MS))
        shown += np.bincount(items, weights, n_items)
        liked += np.bincount(items, weights * liked_of(train, rewards), n_items)
    return TrainingCounts(torch.from_numpy(shown), torch.from_numpy(liked), train.n_episodes)
