"""A policy for ucfrec in a package of its own: a recurrent network over states and past actions.

pip install ./examples/plugin
ucfrec train STORE --out RUN --policy gru --set policy.layers=2
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Layers, PolicyConfig, SequencePolicy, recurrent
from ucfrec.settings import settings_table


@settings_table("policy")
class GRUConfig(PolicyConfig):
    """Settings of the recurrent policy."""

    layers: Layers = 1
    """Layers of the GRU."""


class GRUPolicy(SequencePolicy):
    """Reads the states up to t and the actions before t, one after the other."""

    Config = GRUConfig
    config: GRUConfig

    def __init__(self, config: GRUConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed_state = nn.Linear(sizes["state"], config.dim)
        self.gru = nn.GRU(2 * config.dim, config.dim, config.layers, batch_first=True)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d); row t depends neither on the action of step t nor on padding."""
        actions = self.head.embed(windows.actions) * windows.mask.unsqueeze(-1)
        before = torch.cat([torch.zeros_like(actions[:, :1]), actions[:, :-1]], dim=1)
        steps = torch.cat([self.embed_state(windows.states), before], dim=-1)
        return recurrent(self.gru, steps, windows.mask)
