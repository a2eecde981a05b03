"""Decision ConvFormer (Kim et al., 2024): DT with convolutions in the place of attention."""

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
from ucfrec.settings import settings_table


@settings_table("policy")
class DCConfig(PolicyConfig):
    """Settings of Decision ConvFormer; defaults are those of its official code."""

    layers: Layers = 3
    """Blocks of one convolution and one perceptron."""
    kernel: Kernel = 6
    """Tokens that a convolution sees, 3 a step."""


class DCPolicy(SequencePolicy):
    """Pre-LN blocks of one depthwise convolution a modality over R_0, s_0, a_0, R_1, …

    Source: https://github.com/beanie00/Decision-ConvFormer, whose padding, zeros that are embedded
    like everything else, leaks into the first steps. Here padded tokens are zero before every
    convolution: a padded window gives what the shorter one does.
    """

    Config = DCConfig
    config: DCConfig

    def __init__(self, config: DCConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed = TokenEmbedding(config, sizes["state"])
        self.dropout = nn.Dropout(config.dropout)
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.layers))
        self.final_norm = nn.LayerNorm(config.dim)
        for module in self.blocks.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) at the s_t tokens."""
        hidden = self.dropout(interleave(*self.embed(windows, self.head.embed(windows.actions))))
        there = windows.mask.repeat_interleave(3, dim=1).unsqueeze(-1)
        for block in self.blocks:
            hidden = block(hidden, there)
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
            nn.Linear(dim, 4 * dim), nn.GELU(), nn.Linear(4 * dim, dim), nn.Dropout(config.dropout)
        )

    def forward(self, hidden: Tensor, there: Tensor) -> Tensor:
        normed = self.mixer_norm(hidden).masked_fill(~there, 0.0).transpose(1, 2)  # (B, d, 3K)
        padded = F.pad(normed, (self.reach, 0))
        # The filter is the output token's modality's: with stride 3 only those outputs are made.
        mixed = [conv(padded[..., i:]).transpose(1, 2) for i, conv in enumerate(self.mixers)]
        hidden = hidden + interleave(*mixed)
        return hidden + self.mlp(self.mlp_norm(hidden))  # type: ignore[no-any-return]
