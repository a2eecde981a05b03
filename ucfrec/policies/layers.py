"""Layers that cost less than PyTorch's on a CPU: dropout, attention, a depthwise convolution."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

_LEVELS = 2**16
"""Values of the random 16-bit numbers that decide what a CPU drops."""


class Dropout(nn.Dropout):
    """Sets a share p of the values to 0 and divides the others by 1 − p.

    On a CPU, p is rounded to a multiple of 2⁻¹⁶: four values share one 64-bit draw, which takes a
    fifth of the time of one draw each.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Values of any shape, unchanged in evaluation mode."""
        if not self.training or self.p == 0:
            return input
        if input.device.type != "cpu":
            return F.dropout(input, self.p)
        return input * kept(input.shape, self.p)

    def add(self, residual: Tensor, input: Tensor) -> Tensor:
        """`residual` + this dropout of `input`, both of the same shape, in one pass."""
        if not self.training or self.p == 0 or input.device.type != "cpu":
            dropped: Tensor = self(input)
            return residual + dropped
        return torch.addcmul(residual, input, kept(input.shape, self.p))


def kept(shape: torch.Size, p: float) -> Tensor:
    """Independent draws, float32 on the CPU: 0 with probability p, otherwise 1 / (1 − p).

    Args:
        p: from 0 to 1, rounded to a multiple of 2⁻¹⁶.
    """
    dropped = round(p * _LEVELS)
    if dropped == _LEVELS:
        return torch.zeros(shape)
    mask = torch.empty(shape)
    draws = torch.empty(-(-mask.numel() // 4), dtype=torch.int64).random_(-(2**63), None)
    levels = draws.view(torch.int16)[: mask.numel()].view(shape)
    torch.ge(levels, dropped - _LEVELS // 2, out=mask)
    return mask.mul_(_LEVELS / (_LEVELS - dropped))


def attend(query: Tensor, key: Tensor, value: Tensor, visible: Tensor, dropout: float) -> Tensor:
    """Scaled dot-product attention.

    Args:
        query: (B, H, L, c), as are `key` and `value`.
        key: see `query`.
        value: see `query`.
        visible: (B, 1, L, L) bool, true where a row may attend to a column; somewhere in each row.
        dropout: share of the attention weights that is dropped, as by `Dropout`.

    Returns:
        (B, H, L, c).
    """
    if dropout == 0 or query.device.type != "cpu":
        return F.scaled_dot_product_attention(query, key, value, visible, dropout)
    scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-2, -1)
    weights = scores.masked_fill(~visible, -torch.inf).softmax(-1)
    return torch.matmul(weights * kept(weights.shape, dropout), value)


def some_padding(mask: Tensor) -> Tensor | None:
    """The mask (B, K) of steps that are no padding; None on a CPU if there is no padding at all.

    A graph that is exported holds for every padding.
    """
    on_cpu = mask.device.type == "cpu" and not torch.compiler.is_compiling()
    return None if on_cpu and bool(mask.all()) else mask


def draw_normal(weight: Tensor, std: float = 1.0) -> Tensor:
    """Fill `weight` from N(0, std²), unless it has no memory, as where sizes are compared with
    those of a file: torch would import its compiler, which takes longer than torch itself."""
    if not weight.is_meta:
        nn.init.normal_(weight, std=std)
    return weight


def embedding(rows: int, size: int) -> nn.Embedding:
    """`nn.Embedding(rows, size)`, with `draw_normal`."""
    return nn.Embedding(rows, size, _weight=draw_normal(torch.empty(rows, size)))


def init_linear(module: nn.Module) -> None:
    """Initialise all linear layers as GPT-2 does: weights from N(0, 0.02²), biases 0."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            draw_normal(layer.weight, std=0.02)
            nn.init.zeros_(layer.bias)


class CausalDepthwise(nn.Conv1d):
    """A depthwise convolution over the last 3 steps: the output at t depends on t − 2 to t.

    It has the weights of `nn.Conv1d(dim, dim, 3, groups=dim)`. Adding three shifted products needs
    no transposed copies, which cost more than the convolution itself.
    """

    def __init__(self, dim: int) -> None:
        super().__init__(dim, dim, kernel_size=3, groups=dim)

    def forward(self, input: Tensor, mask: Tensor | None = None) -> Tensor:
        """Map (B, K, d) to (B, K, d).

        Args:
            mask: (B, K) bool, false at steps that count as zeros; None if all count.
        """
        steps = input if mask is None else input.masked_fill(~mask.unsqueeze(-1), 0.0)
        taps = self.weight[:, 0].T.contiguous()  # strided factors take three times as long
        return _ShiftedProducts.apply(steps, taps, self.bias)  # type: ignore[no-any-return, no-untyped-call]


class _ShiftedProducts(torch.autograd.Function):
    """Σ_n x_{t − n} ⊙ w_{2 − n} + b, from x (B, K, d), w (3, d) and b (d,)."""

    @staticmethod
    def forward(ctx: Any, steps: Tensor, taps: Tensor, bias: Tensor) -> Any:
        ctx.save_for_backward(steps, taps)
        out = torch.addcmul(bias, steps, taps[2])
        for back in (1, 2):
            out[:, back:].addcmul_(steps[:, :-back], taps[2 - back])
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        steps, taps = ctx.saved_tensors
        of_steps, of_taps = gradient * taps[2], torch.empty_like(taps)
        of_taps[2] = (gradient * steps).sum((0, 1))
        for back in (1, 2):
            later, earlier = gradient[:, back:], steps[:, :-back]
            of_steps[:, :-back].addcmul_(later, taps[2 - back])
            of_taps[2 - back] = (later * earlier).sum((0, 1))
        return of_steps, of_taps, gradient.sum((0, 1))


class ConvStream(nn.Module):
    """Convolution blocks of one modality (Table 6): x ← LN(x + Dropout(GELU(PW(DW₃(x)))))."""

    def __init__(self, dim: int, blocks: int, dropout: float) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_ConvBlock(dim, dropout) for _ in range(blocks))

    def forward(self, tokens: Tensor, mask: Tensor | None) -> Tensor:
        """Map (B, K, d) to (B, K, d); padded steps are set to zero before every convolution."""
        for block in self.blocks:
            tokens = block(tokens, mask)
        return tokens


class _ConvBlock(nn.Module):
    def __init__(self, dim: int, dropout: float) -> None:
        super().__init__()
        self.depthwise = CausalDepthwise(dim)
        self.pointwise = nn.Linear(dim, dim)
        self.dropout = Dropout(dropout)
        self.norm = nn.LayerNorm(dim)

    def forward(self, tokens: Tensor, mask: Tensor | None) -> Tensor:
        local = self.depthwise(tokens, mask)
        return self.norm(self.dropout.add(tokens, F.gelu(self.pointwise(local))))  # type: ignore[no-any-return]


def convolved(streams: Iterable[nn.Module], tokens: Iterable[Tensor], mask: Tensor) -> list[Tensor]:
    """The tokens (B, K, d) of each modality through its stream; steps outside `mask` count as 0."""
    padded = some_padding(mask)
    return [stream(values, padded) for stream, values in zip(streams, tokens, strict=True)]


def visible_tokens(valid: Tensor) -> Tensor:
    """Causal attention mask (B, 1, L, L), true where row i may attend to column j.

    A token attends to itself and to earlier tokens that are `valid` (B, L), i.e. not padding.
    """
    length = valid.shape[1]
    earlier = torch.ones(length, length, dtype=torch.bool, device=valid.device).tril()
    diagonal = torch.eye(length, dtype=torch.bool, device=valid.device)
    return ((earlier & valid.unsqueeze(1)) | diagonal).unsqueeze(1)


def recurrent(network: nn.GRU, inputs: Tensor, mask: Tensor) -> Tensor:
    """Outputs (B, K, d) of a network for left-padded inputs, whatever the padding before a session.

    The network runs with the padding moved behind the steps.

    Args:
        network: with `batch_first=True`.
        inputs: (B, K, c).
        mask: (B, K) bool, false at padding.
    """
    length = mask.shape[1]
    padding = (~mask).sum(1, keepdim=True)
    places = torch.arange(length, device=mask.device)

    def rolled(x: Tensor, by: Tensor) -> Tensor:
        return x.gather(1, ((places + by) % length).unsqueeze(-1).expand_as(x))

    return rolled(network(rolled(inputs, padding))[0], -padding)
