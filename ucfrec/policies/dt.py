"""Decision Transformer (Chen et al., 2021): the `w/o Arch` backbone and a baseline."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import (
    Heads,
    Layers,
    PolicyConfig,
    SequencePolicy,
    TokenEmbedding,
    interleave,
    require_heads,
)
from ucfrec.settings import settings_table


@settings_table("policy")
class DTConfig(PolicyConfig):
    """Settings of the Decision Transformer; defaults are those of its official code."""

    layers: Layers = 3
    """Blocks of attention and a perceptron."""
    heads: Heads = 1
    """Attention heads of a block; they divide `dim`."""

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        require_heads(self, self.heads)


class DTPolicy(SequencePolicy):
    """GPT-2 blocks without positional embedding over R_0, s_0, a_0, R_1, …; a_t read at s_t.

    Weights as in the official code, less its two unused prediction heads and unused word table.
    """

    Config = DTConfig
    config: DTConfig

    def __init__(self, config: DTConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed = TokenEmbedding(config, sizes["state"])
        self.dropout = nn.Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)
        for module in self.blocks.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) at the s_t tokens."""
        return self.transform(windows)[:, 1::3]

    def transform(self, windows: Windows) -> Tensor:
        """(B, 3K, d) at all tokens, R_0, s_0, a_0, R_1, …"""
        tokens = interleave(*self.embed(windows, self.head.embed(windows.actions)))
        hidden = self.dropout(tokens)
        visible = visible_tokens(windows.mask.repeat_interleave(3, dim=1))
        for block in self.blocks:
            hidden = block(hidden, visible)
        return self.final_norm(hidden)  # type: ignore[no-any-return]


class Block(nn.Module):
    """Pre-LN causal attention and a perceptron."""

    def __init__(self, config: DTConfig) -> None:
        super().__init__()
        dim = config.dim
        self.heads, self.rate = config.heads, config.dropout
        self.attention_norm = nn.LayerNorm(dim)
        self.query_key_value = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, 4 * dim), nn.ReLU(), nn.Linear(4 * dim, dim))
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, hidden: Tensor, visible: Tensor) -> Tensor:
        """(B, L, d) to (B, L, d); `visible` (B, 1, L, L) from `visible_tokens`."""
        batch, tokens, dim = hidden.shape
        # (B, L, 3d) -> three times (B, H, L, d/H)
        query, key, value = (
            x.view(batch, tokens, self.heads, dim // self.heads).transpose(1, 2)
            for x in self.query_key_value(self.attention_norm(hidden)).chunk(3, dim=-1)
        )
        mixed = F.scaled_dot_product_attention(
            query, key, value, attn_mask=visible, dropout_p=self.rate if self.training else 0.0
        )
        hidden = hidden + self.dropout(self.out(mixed.transpose(1, 2).reshape(hidden.shape)))
        return hidden + self.dropout(self.mlp(self.mlp_norm(hidden)))  # type: ignore[no-any-return]


def visible_tokens(there: Tensor) -> Tensor:
    """(B, 1, L, L): tokens at or before one's own that are `there` (B, L), and always oneself."""
    length = there.shape[1]
    earlier = torch.ones(length, length, dtype=torch.bool, device=there.device).tril()
    oneself = torch.eye(length, dtype=torch.bool, device=there.device)
    return ((earlier & there.unsqueeze(1)) | oneself).unsqueeze(1)
