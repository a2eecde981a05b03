"""The features of UCF at the last step of a few windows, with its three streams computed as one."""

from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows
from ucfrec.policies.heads import ItemHead
from ucfrec.policies.layers import some_padding

if TYPE_CHECKING:
    from ucfrec.policies.ucf import UCFPolicy

FEW: Final = 32
"""Windows up to which calling an operation costs more than its arithmetic."""


class StackedStreams:
    """`UCFPolicy.last_features` of a trained policy, equal up to rounding.

    The weights of the three streams are stacked once, so that every operation serves all of them.
    """

    def __init__(self, policy: "UCFPolicy") -> None:
        """
        Args:
            policy: in evaluation mode; its weights must not change afterwards.
        """
        self._policy = policy
        streams = (policy.return_stream, policy.state_stream, policy.action_stream)
        with torch.no_grad():
            layers = zip(*(stream.blocks for stream in streams), strict=True)
            self._blocks = [_stacked(blocks) for blocks in layers]
            self._eps = float(policy.return_stream.blocks[0].norm.eps)  # type: ignore[arg-type,union-attr]
            self._fuse = torch.stack([part.T for part in policy.fuse.weight.chunk(3, dim=1)])
            # The sum over the modalities known so far begins with the bias.
            self._fuse_bias = policy.fuse.bias.expand(3, 1, -1)

    @torch.no_grad()
    def __call__(self, windows: Windows) -> Tensor:
        """Features (B, d) from normalised windows."""
        policy, (batch, length) = self._policy, windows.mask.shape
        if batch > FEW:
            return policy.last_features(windows)
        head = policy.head
        # Vectors of a few items cost less than keeping those of all.
        embed = head.vectors if isinstance(head, ItemHead) else head.embed
        tokens = policy.embed.stacked(windows, embed(windows.actions))
        tokens = self._convolved(tokens, some_padding(windows.mask))
        rows = tokens.view(3, batch * length, -1)
        known = torch.bmm(rows, self._fuse).cumsum(0).add_(self._fuse_bias)
        fused = policy.fuse_norm(known.add_(rows)).view(tokens.shape)
        attended = self._attended(fused, windows.mask)
        hidden = fused[1, :, -1] + attended
        return policy.final_norm(hidden + policy.mlp(policy.mlp_norm(hidden)))  # type: ignore[no-any-return]

    def _convolved(self, tokens: Tensor, mask: Tensor | None) -> Tensor:
        """The three streams of tokens (3, B, K, d); padded steps count as zeros."""
        shape, dim = tokens.shape, tokens.shape[-1]
        for taps, bias, pointwise, pointwise_bias, scale, shift in self._blocks:
            steps = tokens if mask is None else tokens.masked_fill(~mask.unsqueeze(-1), 0.0)
            local = torch.addcmul(bias, steps, taps[2])
            for back in (1, 2):
                local[:, :, back:].addcmul_(steps[:, :, :-back], taps[2 - back])
            rows = torch.baddbmm(pointwise_bias, local.view(3, -1, dim), pointwise)
            normed = F.layer_norm(F.gelu(rows).view(shape).add_(tokens), (dim,), eps=self._eps)
            tokens = torch.addcmul(shift, normed, scale)
        return tokens

    def _attended(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """What the last s_t attends to among tokens (3, B, K, d), (B, d)."""
        layer, (_, batch, length, dim) = self._policy.attention, tokens.shape
        heads, size = layer.heads, dim // layer.heads
        query = layer.query(layer.norm(tokens[1, :, -1])).view(batch, heads, 1, size)
        both = layer.key_value(layer.norm(tokens)).view(3, batch, length, 2, heads, size)
        key, value = both.permute(3, 1, 4, 0, 2, 5).reshape(2, batch, heads, -1, size)
        scores = query @ key.transpose(-2, -1) / size**0.5  # (B, H, 1, 3K)
        hidden = ~mask.repeat(1, 3)
        # Its own action comes after s_t.
        hidden[:, -1] = True
        scores = scores.masked_fill(hidden.view(batch, 1, 1, -1), -torch.inf)
        mixed = (scores.softmax(-1) @ value).view(batch, dim)
        return layer.out(mixed)  # type: ignore[no-any-return]


def _stacked(blocks: tuple[torch.nn.Module, ...]) -> tuple[Tensor, ...]:
    """The weights of one block of each stream."""

    def stacked(name: str) -> Tensor:
        return torch.stack([block.get_parameter(name) for block in blocks])

    taps = stacked("depthwise.weight")[:, :, 0]  # (3, d, 3)
    return (
        taps.permute(2, 0, 1)[:, :, None, None].contiguous(),
        stacked("depthwise.bias")[:, None, None],
        stacked("pointwise.weight").mT.contiguous(),
        stacked("pointwise.bias").unsqueeze(1),
        stacked("norm.weight")[:, None, None],
        stacked("norm.bias")[:, None, None],
    )
