"""The items that users liked best on average: a baseline for every policy that pursues reward."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead

PRIOR: Final = 10.0
"""Steps at the mean rate that are added to every item's own."""


class ItemRatePolicy(SequencePolicy):
    """Scores items by the log-odds of their rate of liked training steps, whatever the inputs.

    With a tag window of the decision rule, it is the baseline "item click rate with a tag mask".
    """

    def closed_form(
        self, train: EpisodeStore, validation: EpisodeStore | None, folder: Path, seed: int
    ) -> Callable[[], None]:
        """Sets the biases of the head.

        Raises:
            InputError: actions are vectors.
        """
        bias = self.item_bias()

        def solve() -> None:
            with torch.no_grad():
                bias.copy_(torch.logit(liked_rates(TrainingCounts.of(train))))

        return solve

    def item_bias(self) -> Tensor:
        """The biases (n_items,) of the head, which are the scores.

        Raises:
            InputError: actions are vectors.
        """
        if not isinstance(self.head, ItemHead):
            raise InputError("item rates need a store of items; this store has vector actions")
        return self.head.bias

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) of zeros."""
        return windows.states.new_zeros(*windows.mask.shape, self.config.dim)


def liked_rates(counts: TrainingCounts) -> Tensor:
    """Share of each item's training steps that were liked, (n_items,), shrunk to the mean share.

    `PRIOR` steps at the mean are added to every item, and half a step to both outcomes of the mean,
    so that no rate is 0 or 1.
    """
    shown, liked = counts.shown.double(), counts.liked.double()
    mean = (liked.sum() + 0.5) / (shown.sum() + 1)
    rates: Tensor = (liked + PRIOR * mean) / (shown + PRIOR)
    return rates.float()
