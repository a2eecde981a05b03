"""Behaviour cloning: predicts the logged action from the current state alone."""

from collections.abc import Mapping

from torch import Tensor, nn

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Context, PolicyConfig, SequencePolicy
from ucfrec.policies.layers import Dropout
from ucfrec.settings import settings_table


@settings_table("policy")
class BCConfig(PolicyConfig):
    """Settings of behaviour cloning, a two-layer perceptron on the current state."""

    context: Context = 1
    """K, steps of a training window; each prediction uses its own state only."""


class BCPolicy(SequencePolicy):
    """Imitates the logging policy; returns-to-go and history are not used."""

    Config = BCConfig
    config: BCConfig

    def __init__(self, config: BCConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        dim = config.dim
        self.net = nn.Sequential(
            nn.Linear(sizes["state"], dim),
            nn.ReLU(),
            Dropout(config.dropout),
            nn.Linear(dim, dim),
            nn.ReLU(),
            nn.LayerNorm(dim),
        )

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d), each from its own state."""
        return self.net(windows.states)  # type: ignore[no-any-return]
