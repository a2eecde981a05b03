"""Decision ConvFormer (Kim et al., 2024): DT with convolutions instead of attention; and the
Long-Short Decision Transformer (Wang et al., 2025): attention and dynamic convolution."""

from collections.abc import Mapping
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import settings
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import (
    Heads,
    Kernel,
    Layers,
    PolicyConfig,
    SequencePolicy,
    Timesteps,
    init_linear,
)
from ucfrec.policies.dt import attend
from ucfrec.policies.ucf import (
    Dropout,
    TokenEmbedding,
    convolve_depthwise,
    interleave,
    visible_tokens,
)
from ucfrec.settings import require, settings_table


@settings_table("policy")
class DCConfig(PolicyConfig):
    """Settings of Decision ConvFormer; defaults are those of the official code."""

    layers: Layers = 3
    """Blocks, each a convolution and a perceptron."""
    kernel: Kernel = 6
    """Kernel size of the convolutions in tokens, 3 per step."""


class DCPolicy(SequencePolicy):
    """Pre-LN blocks over R_0, s_0, a_0, R_1, … with one depthwise convolution per modality.

    Source: https://github.com/beanie00/Decision-ConvFormer. There, zero padding is embedded like
    valid steps and affects the first steps. Here, padded tokens are set to zero before every
    convolution, so that padding a window does not change its outputs.
    """

    Config = DCConfig
    config: DCConfig

    def __init__(self, config: DCConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed = TokenEmbedding(config, sizes["state"])
        self.dropout = Dropout(config.dropout)
        self.blocks = nn.ModuleList(_ConvBlock(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)
        init_linear(self.blocks)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d): outputs at the tokens s_t."""
        tokens = self.embed(windows, self.head.embed(windows.actions))
        hidden = self.dropout(interleave(tokens))
        valid = windows.mask.repeat_interleave(3, dim=1).unsqueeze(-1)
        *first_blocks, last = self.blocks
        for block in first_blocks:
            hidden = block(hidden, valid)
        return self.final_norm(last(hidden, valid, slice(1, None, 3)))  # type: ignore[no-any-return]


class _ConvBlock(nn.Module):
    def __init__(self, config: DCConfig) -> None:
        super().__init__()
        dim = config.dim
        self.mixer_norm = nn.LayerNorm(dim)
        self.mixers = nn.ModuleList(
            nn.Conv1d(dim, dim, config.kernel, groups=dim) for _ in range(3)
        )
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(
            nn.Linear(dim, 4 * dim),
            nn.GELU(),
            nn.Linear(4 * dim, dim),
            Dropout(config.dropout),
        )

    def forward(
        self,
        hidden: Tensor,
        valid: Tensor,
        rows: slice = slice(None),
    ) -> Tensor:
        """The `rows` (B, M, d), or all, of what the block makes of tokens (B, 3K, d)."""
        normed = self.mixer_norm(hidden).masked_fill(~valid, 0.0)
        # Each modality has its own filter: taps (kernel, 3K, d), bias (3K, d).
        steps = hidden.shape[1] // 3
        filters: list[Tensor] = [*self.mixers.parameters()]  # a weight and a bias of each modality
        taps = torch.cat(filters[::2], 1).permute(2, 1, 0)
        bias = torch.stack(filters[1::2])
        mixed = convolve_depthwise(normed, taps.repeat(1, steps, 1), bias.repeat(steps, 1))
        hidden = (hidden + mixed)[:, rows]
        return hidden + self.mlp(self.mlp_norm(hidden))  # type: ignore[no-any-return]


@settings_table("policy")
class LSDTConfig(PolicyConfig):
    """Settings of LSDT; defaults are those of the official code."""

    dropout: settings.Dropout = 0.25
    """Dropout after the mixed branches and the perceptron."""
    max_timestep: Timesteps = 4096
    """Rows of the timestep embedding; later steps share the last row. 1 hides the time."""
    layers: Layers = 3
    """Blocks, each attention and convolution in parallel, then a perceptron."""
    heads: Heads = 2
    """Attention heads per block; must divide half of `dim`."""
    attention_dropout: settings.Dropout = 0.1
    """Dropout after attention."""
    kernel_dropout: settings.Dropout = 0.2
    """Dropout of the kernels, which are computed from each token."""
    kernel: Kernel = 6
    """Kernel size of the convolutions in tokens; the last is the output's own token."""
    kernel_groups: Annotated[int, Field(ge=1, le=8192)] = 16
    """Groups of adjacent channels that share a kernel; must divide half of `dim`."""

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        require(
            self.dim % (2 * self.kernel_groups) == 0 and self.dim % (2 * self.heads) == 0,
            f"policy.dim is {self.dim}; half of it must split into {self.kernel_groups} "
            f"kernel_groups and into {self.heads} heads",
            "policy.dim",
            "policy.kernel_groups",
            "policy.heads",
        )


class LSDTPolicy(SequencePolicy):
    """Post-LN blocks: attention on half of the channels (long), convolution on the rest (short).

    A gate weights both halves. Source:
    https://github.com/WangJinCheng1998/LONG-SHORT-DECISION-TRANSFORMER, without its unused return
    and state heads and without the five of its eleven taps that its causal mask sets to zero.
    Padding is masked in attention and convolutions. As there, every linear layer and the timestep
    embedding start with Xavier's uniform distribution.
    """

    Config = LSDTConfig
    config: LSDTConfig

    def __init__(self, config: LSDTConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed = TokenEmbedding(config, sizes["state"])
        self.blocks = nn.ModuleList(_LongShortBlock(config) for _ in range(config.layers))
        for part in (self.embed, self.blocks, self.head):
            part.apply(_initialise)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d): outputs at the tokens s_t."""
        hidden = interleave(self.embed(windows, self.head.embed(windows.actions)))
        valid = windows.mask.repeat_interleave(3, dim=1)
        for block in self.blocks:
            hidden = block(hidden, valid)
        return hidden[:, 1::3]


def _initialise(module: nn.Module) -> None:
    """Xavier's uniform weights, and biases 0."""
    if isinstance(module, _Attention):
        # Queries, keys and values are three layers of the official code.
        for weight in module.query_key_value.weight.data.chunk(3):
            nn.init.xavier_uniform_(weight)
        nn.init.zeros_(module.query_key_value.bias)
    elif isinstance(module, nn.Linear | nn.Embedding):
        nn.init.xavier_uniform_(module.weight)
        if isinstance(module, nn.Linear):
            nn.init.zeros_(module.bias)


class _LongShortBlock(nn.Module):
    def __init__(self, config: LSDTConfig) -> None:
        super().__init__()
        dim = config.dim
        self.long, self.short = _Attention(config), _DynamicConvolution(config)
        self.squeeze = nn.Linear(dim, dim // 2)
        self.gates = nn.ModuleList(nn.Linear(dim // 2, dim // 2) for _ in range(2))
        self.out = nn.Linear(dim, dim)
        self.norm = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(
            nn.Linear(dim, 4 * dim),
            nn.GELU(),
            nn.Linear(4 * dim, dim),
            Dropout(config.dropout),
        )
        self.mlp_norm = nn.LayerNorm(dim)
        self.dropout = Dropout(config.dropout)

    def forward(self, hidden: Tensor, valid: Tensor) -> Tensor:
        long, short = hidden.chunk(2, dim=-1)
        convolved = self.long(long, valid), self.short(short, valid)
        both = torch.cat(convolved, dim=-1)
        squeezed = F.relu(self.squeeze(both))
        gates = [layer(squeezed) for layer in self.gates]
        gate = torch.cat(gates, dim=-1).softmax(-1)
        hidden = self.norm(hidden + self.dropout(self.out(gate * both)))
        return self.mlp_norm(hidden + self.mlp(hidden))  # type: ignore[no-any-return]


class _Attention(nn.Module):
    def __init__(self, config: LSDTConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.query_key_value = nn.Linear(config.dim // 2, 3 * (config.dim // 2))
        self.dropout = Dropout(config.attention_dropout)

    def forward(self, hidden: Tensor, valid: Tensor) -> Tensor:
        query, key, value = self.query_key_value(hidden).chunk(3, dim=-1)
        return self.dropout(attend(query, key, value, visible_tokens(valid), self.heads))  # type: ignore[no-any-return]


class _DynamicConvolution(nn.Module):
    """A causal convolution whose kernels are computed from each token (Wu et al., 2019)."""

    def __init__(self, config: LSDTConfig) -> None:
        super().__init__()
        dim = config.dim // 2
        self.kernel, self.groups = config.kernel, config.kernel_groups
        self.gated = nn.Linear(dim, 2 * dim)
        self.taps = nn.Linear(dim, config.kernel_groups * config.kernel)
        self.bias = nn.Parameter(torch.zeros(dim))
        self.out = nn.Linear(dim, dim)
        self.dropout = Dropout(config.kernel_dropout)

    def forward(self, hidden: Tensor, valid: Tensor) -> Tensor:
        batch, tokens, dim = hidden.shape
        values = F.glu(self.gated(hidden))
        values = values.masked_fill(~valid.unsqueeze(-1), 0.0)
        # Tokens are the last dimension: 60 numbers side by side, where a group's channels are two.
        taps = self.dropout(self.taps(values)).transpose(1, 2)
        taps = taps.reshape(batch, self.groups, self.kernel, tokens)
        # A kernel's weights sum to 1 over tokens of the window only; the own token is the last.
        present = F.pad(valid, (self.kernel - 1, 0))
        visible = present.unfold(1, tokens, 1).clone()
        visible[:, -1] = True
        taps = taps.masked_fill(~visible.unsqueeze(1), -torch.inf).softmax(2)
        # (B, c, 5 + L) -> (B, groups, c/groups, 5 + L)
        padded = F.pad(values.transpose(1, 2), (self.kernel - 1, 0))
        padded = padded.view(batch, self.groups, dim // self.groups, -1)
        mixed = torch.zeros_like(padded[..., :tokens])
        for tap in range(self.kernel):
            mixed = mixed + padded[..., tap : tap + tokens] * taps[:, :, tap, None]
        mixed = mixed.view(batch, dim, tokens).transpose(1, 2)
        return self.out(mixed + self.bias)  # type: ignore[no-any-return]
