"""Decision Transformer (Chen et al., 2021): a baseline and the backbone of `w/o Arch`."""

from collections.abc import Iterable, Mapping

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
from ucfrec.policies.layers import Dropout, attend, init_linear, visible_tokens
from ucfrec.settings import settings_table


@settings_table("policy")
class DTConfig(PolicyConfig):
    """Settings of the Decision Transformer; defaults are those of the official code."""

    layers: Layers = 3
    """Transformer blocks, each attention and a perceptron."""
    heads: Heads = 1
    """Attention heads per block; must divide `dim`."""

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        require_heads(self, self.heads)


class DTPolicy(SequencePolicy):
    """GPT-2 blocks without positional embedding over R_0, s_0, a_0, R_1, …; s_t predicts a_t.

    The weights are those of the official code without its unused prediction heads and word table.
    """

    Config = DTConfig
    config: DTConfig

    def __init__(self, config: DTConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed = TokenEmbedding(config, sizes["state"])
        self.dropout = Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)
        init_linear(self.blocks)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d): outputs at the tokens s_t."""
        return self.transform(windows)[:, 1::3]

    def transform(self, windows: Windows) -> Tensor:
        """Outputs at all tokens R_0, s_0, a_0, R_1, …, (B, 3K, d), from normalised windows."""
        return self.attended(self.tokens(windows), windows.mask)

    def tokens(self, windows: Windows) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens R_t, s_t and a_t, (B, K, d) each, from normalised windows."""
        return self.embed(windows, self.head.embed(windows.actions))  # type: ignore[no-any-return]

    def attended(self, tokens: tuple[Tensor, Tensor, Tensor], mask: Tensor) -> Tensor:
        """Outputs (B, 3K, d) at tokens of `tokens`; `mask` (B, K) is false at padding."""
        hidden, visible = self._first(tokens, mask)
        for block in self.blocks:
            hidden = block(hidden, visible)
        return self.final_norm(hidden)  # type: ignore[no-any-return]

    def last_features(self, windows: Windows) -> Tensor:
        """Row K − 1 of `features`, (B, d), without what the last block has for other tokens."""
        first = self._first(self.tokens(windows), windows.mask)
        state = slice(-2, -1)
        return self.final_norm(rows_through(self.blocks, *first, state))[:, 0]  # type: ignore[no-any-return]

    def _first(self, tokens: tuple[Tensor, Tensor, Tensor], mask: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs of the first block (B, 3K, d), and which of them see which, (B, 1, 3K, 3K)."""
        visible = visible_tokens(mask.repeat_interleave(3, dim=1))
        return self.dropout(interleave(*tokens)), visible


class Block(nn.Module):
    """Pre-LN Transformer block: causal attention and a perceptron."""

    def __init__(self, config: DTConfig) -> None:
        super().__init__()
        dim = config.dim
        self.heads, self.rate = config.heads, config.dropout
        self.attention_norm = nn.LayerNorm(dim)
        self.query_key_value = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, 4 * dim), nn.ReLU(), nn.Linear(4 * dim, dim))
        self.dropout = Dropout(config.dropout)

    def forward(self, hidden: Tensor, visible: Tensor) -> Tensor:
        """Map (B, L, d) to (B, L, d); `visible` (B, 1, L, L) comes from `visible_tokens`."""
        query, key, value = self.query_key_value(self.attention_norm(hidden)).chunk(3, dim=-1)
        return self._updated(hidden, query, key, value, visible)

    def rows(self, hidden: Tensor, visible: Tensor, rows: slice) -> Tensor:
        """The `rows` of what `forward` gives, (B, M, d)."""
        layer, dim, normed = self.query_key_value, hidden.shape[-1], self.attention_norm(hidden)
        query = F.linear(normed[:, rows], layer.weight[:dim], layer.bias[:dim])
        key, value = F.linear(normed, layer.weight[dim:], layer.bias[dim:]).chunk(2, dim=-1)
        return self._updated(hidden[:, rows], query, key, value, visible[:, :, rows])

    def _updated(
        self, hidden: Tensor, query: Tensor, key: Tensor, value: Tensor, visible: Tensor
    ) -> Tensor:
        """Tokens (B, M, d) whose queries (B, M, d) have attended to keys and values (B, L, d)."""
        batch, _, dim = hidden.shape
        # (B, L, d) -> (B, H, L, d/H)
        query, key, value = (
            x.view(batch, -1, self.heads, dim // self.heads).transpose(1, 2)
            for x in (query, key, value)
        )
        mixed = attend(query, key, value, visible, self.rate if self.training else 0.0)
        hidden = hidden + self.dropout(self.out(mixed.transpose(1, 2).reshape(hidden.shape)))
        return hidden + self.dropout(self.mlp(self.mlp_norm(hidden)))  # type: ignore[no-any-return]


def rows_through(
    blocks: Iterable[nn.Module], hidden: Tensor, visible: Tensor, rows: slice
) -> Tensor:
    """The `rows` (B, M, d) of what `Block`s make of (B, L, d), by `visible` (B, 1, L, L)."""
    *first_blocks, last = blocks
    assert isinstance(last, Block)
    for block in first_blocks:
        hidden = block(hidden, visible)
    return last.rows(hidden, visible, rows)
