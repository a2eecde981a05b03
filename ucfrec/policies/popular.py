"""A constant policy: the most popular item, or the mean logged action."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import VectorHead

_WITHIN = 0.999
"""Largest share of an action's range that the hyperbolic tangent of the head is to reach."""


class PopularPolicy(SequencePolicy):
    """Baseline that ignores its inputs: only the biases of the head matter.

    They are the logs of the items' shares of the training steps, one step added to each item, or
    give the mean logged action vector. Only the components of the head that settings switch on
    (exposure, values) are learned by gradient.
    """

    def closed_form(
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
