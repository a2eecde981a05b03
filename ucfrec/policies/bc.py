"""Behaviour cloning: predicts the logged action from the current state alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from torch import Tensor, nn

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Context, PolicyConfig, SequencePolicy
from ucfrec.settings import settings_table


@settings_table("policy")
class BCConfig(PolicyConfig):
    """Settings of behaviour cloning, a two-layer perceptron on the current state."""

    context: Context = 1
    """K, steps of a training window; each prediction uses its own state only."""
    best_share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the training episodes to imitate, those with the highest returns; 0.1 is the 10% BC
    of Chen et al. (2021)."""


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
            nn.Dropout(config.dropout),
            nn.Linear(dim, dim),
            nn.ReLU(),
            nn.LayerNorm(dim),
        )

    @classmethod
    def training_view(
        cls, train: EpisodeStore, config: PolicyConfig, folder: Path, seed: int
    ) -> EpisodeStore:
        """The share `best_share` of the episodes, those with the highest returns."""
        assert isinstance(config, BCConfig)
        count = int(np.ceil(config.best_share * train.n_episodes))
        best = np.argsort(-train.returns, kind="stable")[:count]
        return train.select(np.sort(best))

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d), each from its own state."""
        return self.net(windows.states)  # type: ignore[no-any-return]
