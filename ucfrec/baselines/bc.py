"""Behaviour cloning: the logged action from the current state alone."""

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from ucfrec.policy import PolicyConfig, SequencePolicy
from ucfrec.windows import Windows


@dataclass(frozen=True)
class BCConfig(PolicyConfig):
    """A two-layer perceptron without memory."""

    context: int = 1


class BCPolicy(SequencePolicy):
    """Imitates the logging policy; neither returns-to-go nor history enter."""

    Config = BCConfig
    config: BCConfig

    def __init__(self, config: BCConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        dim = config.dim
        self.net = nn.Sequential(
            nn.Linear(sizes["state"], dim),
            nn.ReLU(),
            nn.Dropout(config.dropout),
            nn.Linear(dim, dim),
            nn.ReLU(),
            nn.LayerNorm(dim),
        )

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d), each from its own state."""
        return self.net(windows.states)  # type: ignore[no-any-return]
