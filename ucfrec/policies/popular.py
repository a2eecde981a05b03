"""The same answer for everybody: the most popular item, or the mean logged action."""

from torch import Tensor

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import SequencePolicy


class PopularPolicy(SequencePolicy):
    """A floor that knows nobody: the head sees nothing, so that only its biases learn."""

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) of zeros."""
        return windows.states.new_zeros(*windows.mask.shape, self.config.dim)
