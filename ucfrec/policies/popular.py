"""A constant policy: the most popular item, or the mean logged action."""

from torch import Tensor

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import SequencePolicy


class PopularPolicy(SequencePolicy):
    """Baseline that ignores its inputs: only the biases of the head are learned."""

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) of zeros."""
        return windows.states.new_zeros(*windows.mask.shape, self.config.dim)
