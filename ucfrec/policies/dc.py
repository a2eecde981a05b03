"""Decision ConvFormer (Kim et al., 2024): DT with convolutions instead of attention."""

from collections.abc import Mapping

from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import (
    Kernel,
    Layers,
    PolicyConfig,
    SequencePolicy,
    TokenEmbedding,
    interleave,
)
from ucfrec.policies.layers import Dropout, init_linear
from ucfrec.settings import settings_table


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
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)
        init_linear(self.blocks)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d): outputs at the tokens s_t."""
        hidden = self.dropout(interleave(*self.embed(windows, self.head.embed(windows.actions))))
        valid = windows.mask.repeat_interleave(3, dim=1).unsqueeze(-1)
        for block in self.blocks:
            hidden = block(hidden, valid)
        return self.final_norm(hidden[:, 1::3])  # type: ignore[no-any-return]


class _Block(nn.Module):
    def __init__(self, config: DCConfig) -> None:
        super().__init__()
        dim = config.dim
        self.reach = config.kernel - 1
        self.mixer_norm = nn.LayerNorm(dim)
        self.mixers = nn.ModuleList(
            nn.Conv1d(dim, dim, config.kernel, stride=3, groups=dim) for _ in range(3)
        )
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(
            nn.Linear(dim, 4 * dim), nn.GELU(), nn.Linear(4 * dim, dim), Dropout(config.dropout)
        )

    def forward(self, hidden: Tensor, valid: Tensor) -> Tensor:
        normed = self.mixer_norm(hidden).masked_fill(~valid, 0.0).transpose(1, 2)  # (B, d, 3K)
        padded = F.pad(normed, (self.reach, 0))
        # Each modality has its own filter; stride 3 computes only the outputs of that modality.
        mixed = [conv(padded[..., i:]).transpose(1, 2) for i, conv in enumerate(self.mixers)]
        hidden = hidden + interleave(*mixed)
        return hidden + self.mlp(self.mlp_norm(hidden))  # type: ignore[no-any-return]
