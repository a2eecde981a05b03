"""Items by what happened to them in the training rows, whatever the session shows: baselines."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray
from ucfrec.episodes.states import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import PolicyConfig, SequencePolicy
from ucfrec.policies.heads import ItemHead, VectorHead
from ucfrec.settings import settings_table

PRIOR: Final = 10.0
"""Steps at the mean rate that are added to every item's own."""
HALF_LIVES: Final = (3.0, 6.0, 12.0, 24.0, 48.0, 96.0, 192.0, 384.0, 768.0, math.inf)
"""Hours after which a row counts half; those that are tried."""
_HOUR_MS: Final = 3_600_000
_SMOOTHING: Final = 1.0
"""Clicks that are added to all items together."""
_WITHIN = 0.999
"""Largest share of an action's range that the hyperbolic tangent of the head is to reach."""

LikedOf = Callable[[EpisodeStore, Array], BoolArray]


class PopularPolicy(SequencePolicy):
    """The most popular item, or the mean logged action: only the biases of the head matter.

    They are the logs of the items' shares of the training steps, one step added to each item, or
    give the mean logged action vector. Only the components of the head that settings switch on
    (exposure, values) are learned by gradient.
    """

    def make_solver(
        self, train: EpisodeStore, validation: EpisodeStore | None, folder: Path, seed: int
    ) -> Callable[[], None] | None:
        """Sets the biases, unless settings add something to learn."""
        config = self.config
        if config.exposure or config.advantage_weights or config.max_return:
            return None
        return lambda: self._set_mean(train)

    @torch.no_grad()
    def _set_mean(self, train: EpisodeStore) -> None:
        if isinstance(self.head, VectorHead):
            actions = torch.from_numpy(train.step_values(schema.ACTION, *train.all_steps()))
            mean = actions.double().mean(0).to(self.head.scale) / self.head.scale
            self.head.out.bias.copy_(torch.atanh(mean.clamp(-_WITHIN, _WITHIN)))

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) of zeros."""
        return windows.states.new_zeros(*windows.mask.shape, self.config.dim)


class ItemRatePolicy(PopularPolicy):
    """Scores items by the log-odds of their rate of liked training steps.

    With a tag window of the decision rule, it is the baseline "item click rate with a tag mask".
    """

    by_rate: ClassVar[bool] = True
    """Whether scores are rates of likes, or else shares of all likes."""

    def make_solver(
        self, train: EpisodeStore, validation: EpisodeStore | None, folder: Path, seed: int
    ) -> Callable[[], None]:
        """Sets the biases of the head.

        Raises:
            InputError: actions are vectors.
        """
        if not isinstance(self.head, ItemHead):
            raise InputError("item rates need a store of items; this store has vector actions")
        bias = self.head.bias

        def solve() -> None:
            with torch.no_grad():
                bias.copy_(self.scores_of(self._counts(train, validation)))

        return solve

    def _counts(self, train: EpisodeStore, validation: EpisodeStore | None) -> TrainingCounts:
        return TrainingCounts.of(train)

    @classmethod
    def scores_of(cls, counts: TrainingCounts) -> Tensor:
        """Log-odds (n_items,) of the rate of likes, or logarithms of the shares of likes."""
        if cls.by_rate:
            return torch.logit(liked_rates(counts))
        likes = counts.liked.double() + _SMOOTHING / len(counts.liked)
        return torch.log(likes / likes.sum()).float()


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

    def _counts(self, train: EpisodeStore, validation: EpisodeStore | None) -> TrainingCounts:
        if validation is not None and not self.config.half_life:
            self.half_life.fill_(self.best_half_life(train, validation))
        return decayed_counts(train, float(self.half_life))

    @classmethod
    def _loss(cls, counts: TrainingCounts, held_out: TrainingCounts) -> float:
        """Mean loss (nats) of held-out steps, or of the items liked there."""
        scores, likes = cls.scores_of(counts), held_out.liked.double()
        if not cls.by_rate:
            return -float((likes * scores).sum() / likes.sum())
        rates = torch.sigmoid(scores.double())
        losses = likes * rates.log() + (held_out.shown - likes) * torch.log1p(-rates)
        return -float(losses.sum() / held_out.shown.sum())

    @classmethod
    def best_half_life(
        cls, train: EpisodeStore, validation: EpisodeStore, liked_of: LikedOf = liked_rewards
    ) -> float:
        """The half-life (hours) with the lowest loss on validation episodes; of equal ones, the
        longest."""
        held_out = TrainingCounts.of(validation, liked_of)
        losses = [
            cls._loss(decayed_counts(train, hours, liked_of), held_out) for hours in HALF_LIVES
        ]
        finite = [loss if math.isfinite(loss) else math.inf for loss in losses]
        return HALF_LIVES[len(losses) - 1 - int(np.argmin(finite[::-1]))]


class RecentClicksPolicy(RecentRatePolicy):
    """Scores items by their share of likes in the training rows, of which older ones count less.

    The half-life has the lowest log loss of the items liked in the validation rows.
    """

    by_rate = False


def liked_rates(counts: TrainingCounts) -> Tensor:
    """Share of each item's training steps that were liked, (n_items,), shrunk to the mean share.

    `PRIOR` steps at the mean are added to every item, and half a step to both outcomes of the mean,
    so that no rate is 0 or 1.
    """
    shown, liked = counts.shown.double(), counts.liked.double()
    mean = (liked.sum() + 0.5) / (shown.sum() + 1)
    rates: Tensor = (liked + PRIOR * mean) / (shown + PRIOR)
    return rates.float()


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
