"""Behaviour cloning: the logged action from the current state alone."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor, nn

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import PolicyConfig, SequencePolicy


@dataclass(frozen=True)
class BCConfig(PolicyConfig):
    """A two-layer perceptron without memory."""

    context: int = 1
    best_share: float = 1.0
    """Share of the training episodes, those with the highest returns, that is imitated: 0.1 is the
    10% BC of Chen et al. (2021)."""


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

    @classmethod
    def training_view(
        cls, train: EpisodeStore, config: PolicyConfig, folder: Path, seed: int
    ) -> EpisodeStore:
        """The best episodes.

        Raises:
            InputError: `best_share` is not above 0 and at most 1.
        """
        assert isinstance(config, BCConfig)
        if not 0 < config.best_share <= 1:
            raise InputError(f"policy.best_share is {config.best_share}; give a share up to 1")
        count = int(np.ceil(config.best_share * train.n_episodes))
        best = np.argsort(-train.returns, kind="stable")[:count]
        return train.select(np.sort(best))

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d), each from its own state."""
        return self.net(windows.states)  # type: ignore[no-any-return]
