"""SASRec (Kang & McAuley, 2018): predicts the next action from the earlier actions alone."""

from collections.abc import Mapping

from torch import Tensor, nn

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Layers, SequencePolicy
from ucfrec.policies.dt import Block, DTConfig, rows_through
from ucfrec.policies.layers import Dropout, embedding, visible_tokens
from ucfrec.settings import settings_table


@settings_table("policy")
class SASRecConfig(DTConfig):
    """Settings of SASRec; two blocks with one head, as in the paper."""

    layers: Layers = 2
    """Transformer blocks, each attention and a perceptron."""


class SASRecPolicy(SequencePolicy):
    """Causal self-attention over a_0, …, a_{t−1}; states, rewards and returns are not used.

    Positions are steps of the episode. The loss is the action head's softmax over all items, or a
    sampled one; the paper's loss contrasts the item with a single random item.
    """

    Config = SASRecConfig
    config: SASRecConfig

    def __init__(self, config: SASRecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed_timestep = embedding(config.max_timestep, config.dim)
        self.dropout = Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d); row t depends on the actions before t."""
        hidden, visible = self._tokens(windows)
        for block in self.blocks:
            hidden = block(hidden, visible)
        return self.final_norm(hidden)  # type: ignore[no-any-return]

    def last_features(self, windows: Windows) -> Tensor:
        """Row K − 1 of `features`, (B, d), without what the last block has for other steps."""
        step = slice(-1, None)
        return self.final_norm(rows_through(self.blocks, *self._tokens(windows), step))[:, 0]  # type: ignore[no-any-return]

    def _tokens(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """The first block's tokens (B, K, d), and which of them see which, (B, 1, K, K)."""
        before = self.head.embed(windows.actions).roll(1, dims=1)
        # The first step of a window has no earlier action in the window.
        known = windows.mask & windows.mask.roll(1, dims=1)
        known[:, 0] = False
        last = self.embed_timestep.num_embeddings - 1
        time = self.embed_timestep(windows.timesteps.clamp(max=last))
        tokens = before.masked_fill(~known.unsqueeze(-1), 0.0) + time
        return self.dropout(tokens), visible_tokens(windows.mask)
