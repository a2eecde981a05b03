"""SASRec (Kang & McAuley, 2018): the next action from the actions before, whatever they earned."""

from collections.abc import Mapping

from torch import Tensor, nn

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Layers, SequencePolicy
from ucfrec.policies.dt import Block, DTConfig, visible_tokens
from ucfrec.settings import settings_table


@settings_table("policy")
class SASRecConfig(DTConfig):
    """Settings of SASRec: two blocks of one head, as published."""

    layers: Layers = 2
    """Blocks of attention and a perceptron."""


class SASRecPolicy(SequencePolicy):
    """Causal self-attention over a_0, …, a_{t−1}; neither states nor returns enter.

    Positions are steps of the episode. The loss is the shared head's softmax over all items (or a
    sample of them, corrected), where the published one contrasts with a single random item.
    """

    Config = SASRecConfig
    config: SASRecConfig

    def __init__(self, config: SASRecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed_timestep = nn.Embedding(config.max_timestep, config.dim)
        self.dropout = nn.Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d); row t sees the actions before t."""
        before = self.head.embed(windows.actions).roll(1, dims=1)
        # The first step of a window has no action before it that the window holds.
        known = windows.mask & windows.mask.roll(1, dims=1)
        known[:, 0] = False
        last = self.embed_timestep.num_embeddings - 1
        time = self.embed_timestep(windows.timesteps.clamp(max=last))
        hidden = self.dropout(before.masked_fill(~known.unsqueeze(-1), 0.0) + time)
        visible = visible_tokens(windows.mask)
        for block in self.blocks:
            hidden = block(hidden, visible)
        return self.final_norm(hidden)  # type: ignore[no-any-return]
