"""UCF's hybrid causal architecture (paper section 3.2), and the layers that it shares with others.

Dropout, attention and convolution cost less here than PyTorch's on a CPU.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import (
    Heads,
    Layers,
    PolicyConfig,
    Returns,
    SequencePolicy,
    embed_time,
    embedding,
    require_heads,
    some_padding,
)
from ucfrec.settings import Share, Weight, settings_table

EPSILON = 1e-8
"""Added inside the logarithm of Eq. 5 (Table 7)."""
_LEVELS = 2**16
"""Values of the random 16-bit numbers that decide what a CPU drops."""


@settings_table("policy")
class UCFConfig(PolicyConfig):
    """Settings of UCF's hybrid policy.

    Defaults are those of the paper's Tables 6 to 8, as far as they name a setting, except λ, which
    was chosen on validation episodes, as was the weight of a_{t−1} (`benchmarks/LOG.md`).
    """

    conv_blocks: Layers = 2
    """Convolution blocks of each stream (returns-to-go, states, actions)."""
    heads: Heads = 2
    """Attention heads; must divide `dim`."""
    lambda_mask: Weight = 0.0
    """λ, weight of the mask loss, which supervises attention. Every value above 0 lowered the
    return in both simulated environments in which it was varied."""
    parent_window: Annotated[int, Field(ge=0, le=4096)] = 2
    """w, number of earlier states that are parents of an action in the mask loss."""
    parent_decay: Share = 0.6
    """Weight of the parent s_{t−k} is this to the power k."""
    parent_action: Weight = 0.3
    """Weight of the parent a_{t−1}."""
    exposure: bool = True
    """Whether the logits of items depend on what the session was shown lately: on repetitions, and
    on shared tags or, without tags, on similar embeddings."""

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        require_heads(self, self.heads)


@settings_table("policy")
class UCFPaperConfig(UCFConfig):
    """Settings of the policy as read in the paper: attention is supervised."""

    lambda_mask: Weight = 0.1
    """λ, weight of the mask loss, which supervises attention; not printed in the paper: ours."""
    exposure: bool = False
    """Whether the logits of items depend on what the session was shown lately."""
    return_to_go: Returns = "session"
    """What returns-to-go count: the whole rest of the session (section 2.1)."""


class UCFPolicy(SequencePolicy):
    """One convolution stream per modality, then an attention block supervised by causal parents.

    Sources: section 3.2, Appendix G.3, Tables 6 to 8. The queries of the attention block are the
    tokens s_t, which predict the actions; keys and values are all 3K tokens.
    """

    Config = UCFConfig
    config: UCFConfig

    def __init__(self, config: UCFConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        dim = config.dim
        self.embed = TokenEmbedding(config, sizes["state"])
        self.return_stream = ConvStream(config)
        self.state_stream = ConvStream(config)
        self.action_stream = ConvStream(config)
        self.fuse = nn.Linear(3 * dim, dim)
        self.fuse_norm = nn.LayerNorm(dim)
        self.attention = SupervisedAttention(config)
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(
            nn.Linear(dim, 4 * dim),
            nn.GELU(),
            nn.Linear(4 * dim, dim),
        )
        self.dropout = Dropout(config.dropout)
        self.final_norm = nn.LayerNorm(dim)

    def features(self, windows: Windows) -> Tensor:
        """Features (B, K, d): outputs at the tokens s_t."""
        return self.attend(windows)[0]

    def attend(self, windows: Windows, rows: slice = slice(None)) -> tuple[Tensor, Tensor]:
        """Features (B, Q, d) and attention probabilities (B, H, Q, 3K) of the `rows`, Q of the K
        steps, from normalised windows."""
        states, tokens = self._fuse_streams(windows)
        states, visible = states[:, rows], _visible(windows.mask)[:, rows]
        attended, attention = self.attention(states, tokens, visible)
        hidden = self.dropout.add(states, attended)
        hidden = self.dropout.add(hidden, self.mlp(self.mlp_norm(hidden)))
        return self.final_norm(hidden), attention

    def last_features(self, windows: Windows) -> Tensor:
        """Row K − 1 of `features`, (B, d): attention has a single query."""
        return self.attend(windows, slice(-1, None))[0][:, 0]

    def _fuse_streams(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """The tokens s_t (B, K, d), and all tokens (B, 3K, d), once their streams are fused."""
        padded = some_padding(windows.mask)
        tokens = self.embed(windows, self.head.embed(windows.actions))
        returns = self.return_stream(tokens[0], padded)
        states = self.state_stream(tokens[1], padded)
        actions = self.action_stream(tokens[2], padded)
        # A linear layer on the concatenation of the modalities known so far ([R, 0, 0], [R, s, 0],
        # [R, s, a]) equals a running sum of the products with the three blocks of its weight.
        of_return, of_state, of_action = self.fuse.weight.chunk(3, dim=1)
        revealed = F.linear(returns, of_return, self.fuse.bias)
        fused_returns = self.fuse_norm(returns + revealed)
        revealed = revealed + F.linear(states, of_state)
        fused_states = self.fuse_norm(states + revealed)
        revealed = revealed + F.linear(actions, of_action)
        fused_actions = self.fuse_norm(actions + revealed)
        return fused_states, interleave([fused_returns, fused_states, fused_actions])

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """L_action + λ L_mask over all steps (Eq. 5, Algorithm 6), and scalars to log."""
        config, normalized = self.config, self.normalize(windows)
        features, attention = self.attend(normalized)
        imitation, scalars = self.imitation(features, normalized)
        if config.lambda_mask == 0:
            return imitation, scalars
        mask = windows.mask
        targets = parent_targets(
            mask, config.parent_window, config.parent_decay, config.parent_action
        )
        supervision = mask_loss(attention, targets, mask)
        parents, visible = targets > 0, _visible(mask)
        on_parents = (attention.detach().mean(1) * parents).sum(-1)
        uniform = (parents & visible).sum(-1) / visible.sum(-1)
        scalars["mask_loss"] = supervision.detach()
        scalars["attention_on_parents"] = on_parents[mask].mean()
        scalars["uniform_on_parents"] = uniform[mask].mean()
        return imitation + config.lambda_mask * supervision, scalars


class UCFPaperPolicy(UCFPolicy):
    """UCF as read in the paper, without what later measurements added: supervised attention, a
    plain CVAE and the paper's generator on all transitions, returns of the whole rest, and the most
    probable action at the largest training return."""

    Config = UCFPaperConfig
    augmented = True
    literal = True
    presets: ClassVar[Mapping[str, Any]] = {
        "train.learning_rate": 1e-4,
        "train.warmup_steps": 500,
        "train.validate_every": 500,
        "train.patience": 0,
        "crm.mean_first": False,
        "crm.learning_rate": 3e-4,
        "crm.epochs": 40,
        "crm.max_transitions": 10**9,
        "csg.kind": "faithful",
        "csg.max_transitions": 10**9,
        "augment.max_steps": 10**9,
        "rule.choose": False,
        "train.average": 0.0,
    }


class SupervisedAttention(nn.Module):
    """Multi-head attention from the tokens s_t to all tokens up to s_t (Table 7)."""

    def __init__(self, config: UCFConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm = nn.LayerNorm(config.dim)
        self.query = nn.Linear(config.dim, config.dim)
        self.key_value = nn.Linear(config.dim, 2 * config.dim)
        self.out = nn.Linear(config.dim, config.dim)
        self.dropout = Dropout(config.dropout)

    def forward(
        self,
        states: Tensor,
        tokens: Tensor,
        visible: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Attend from `states` (B, Q, d) to `tokens` (B, 3K, d), R_0, s_0, a_0, R_1, …, that are
        `visible` (B, Q, 3K), at least one in a row: output (B, Q, d) without dropout of its own,
        and probabilities (B, H, Q, 3K) before dropout."""
        width = states.shape[-1] // self.heads
        # Heads are slices, which matrix products read where they lie; heads as a dimension of the
        # tensors would be copied before and after every product.
        queries = self.query(self.norm(states)).split(width, -1)
        key_value = self.key_value(self.norm(tokens)).split(width, -1)
        keys, values = key_value[: self.heads], key_value[self.heads :]
        products = [q @ k.mT for q, k in zip(queries, keys, strict=True)]
        scores = torch.stack(products, 1)
        scores = (scores / width**0.5).masked_fill(~visible.unsqueeze(1), -torch.inf)
        attention = scores.softmax(-1)  # (B, H, Q, 3K)
        shares = self.dropout(attention).unbind(1)
        heads = [share @ value for share, value in zip(shares, values, strict=True)]
        mixed = torch.cat(heads, -1)
        return self.out(mixed), attention


class Dropout(nn.Dropout):
    """Sets a share p of the values to 0 and divides the others by 1 − p.

    On a CPU, four values share one 64-bit draw, which takes a fifth of the time of one draw each.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Values of any shape, unchanged in evaluation mode."""
        if not self.training or self.p == 0:
            return input
        if input.device.type != "cpu":
            return F.dropout(input, self.p)
        return input * draw_mask(input.shape, self.p)

    def add(self, residual: Tensor, input: Tensor) -> Tensor:
        """`residual` + this dropout of `input`, both of the same shape, in one pass."""
        if not self.training or self.p == 0 or input.device.type != "cpu":
            dropped: Tensor = self(input)
            return residual + dropped
        return torch.addcmul(residual, input, draw_mask(input.shape, self.p))


def draw_mask(shape: torch.Size, p: float) -> Tensor:
    """Float32 draws on the CPU: 0 with probability p (in multiples of 2⁻¹⁶), else 1 / (1 − p)."""
    dropped = round(p * _LEVELS)
    if dropped == _LEVELS:
        return torch.zeros(shape)
    mask = torch.empty(shape)
    count = -(-mask.numel() // 4)  # four levels a number
    draws = torch.empty(count, dtype=torch.int64).random_(-(2**63), None)
    levels = draws.view(torch.int16)[: mask.numel()].view(shape)
    torch.ge(levels, dropped - _LEVELS // 2, out=mask)
    return mask.mul_(_LEVELS / (_LEVELS - dropped))


class TokenEmbedding(nn.Module):
    """Tokens of returns-to-go, states and actions (Appendix G.3): one linear layer per modality, a
    shared learned timestep embedding, LayerNorm."""

    def __init__(self, config: PolicyConfig, state_size: int) -> None:
        super().__init__()
        self.embed_return: nn.Module = nn.Linear(1, config.dim)
        self.embed_state = nn.Linear(state_size, config.dim)
        self.embed_timestep = embedding(config.max_timestep, config.dim)
        self.norm = nn.LayerNorm(config.dim)

    def forward(self, windows: Windows, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens of returns-to-go, states and actions, (B, K, d) each, from normalised windows and
        embedded actions (B, K, d)."""
        time = embed_time(self.embed_timestep, windows)
        returns = self.norm(self.embed_return(windows.returns_to_go.unsqueeze(-1)) + time)
        states = self.norm(self.embed_state(windows.states) + time)
        return returns, states, self.norm(actions + time)


def interleave(modalities: Sequence[Tensor]) -> Tensor:
    """Merge returns, states and actions, (B, K, d) each, into (B, 3K, d): R_0, s_0, a_0, R_1, …"""
    return torch.stack(list(modalities), dim=2).flatten(1, 2)


class CausalDepthwise(nn.Conv1d):
    """A depthwise convolution over the last 3 steps: the output at t depends on t − 2 to t.

    It has the weights of `nn.Conv1d(dim, dim, 3, groups=dim)`. Adding three shifted products needs
    no transposed copies, which cost more than the convolution itself.
    """

    def __init__(self, dim: int) -> None:
        super().__init__(dim, dim, kernel_size=3, groups=dim)

    def forward(self, input: Tensor, mask: Tensor | None = None) -> Tensor:
        """Map (B, K, d) to (B, K, d); steps where the mask (B, K) is false count as zeros."""
        steps = input if mask is None else input.masked_fill(~mask.unsqueeze(-1), 0.0)
        taps = self.weight[:, 0].T.contiguous()  # strided factors take three times as long
        return convolve_depthwise(steps, taps[:, None], self.bias[None])  # type: ignore[index]


def convolve_depthwise(steps: Tensor, taps: Tensor, bias: Tensor) -> Tensor:
    """A causal depthwise convolution, Σ_n x_{t − n} ⊙ w_{n, t} + b_t, as (B, K, d).

    Args:
        steps: x (B, K, d); those before the first are zeros.
        taps: w (n, 1, d), the last of the step itself; (n, K, d) if steps differ in it.
        bias: b (1, d) or (K, d).
    """
    return _ShiftedProducts.apply(steps, taps, bias)  # type: ignore[no-any-return, no-untyped-call]


class _ShiftedProducts(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        steps: Tensor,
        taps: Tensor,
        bias: Tensor,
    ) -> Any:
        ctx.save_for_backward(steps, taps)
        out = torch.addcmul(bias, steps, taps[-1])
        for back in range(1, len(taps)):
            later = _taps_of_later(taps[-1 - back], back)
            out[:, back:].addcmul_(steps[:, :-back], later)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        steps, taps = ctx.saved_tensors
        over = (0, 1) if taps.shape[1] == 1 else (0,)
        of_steps, of_taps = gradient * taps[-1], torch.zeros_like(taps)
        of_taps[-1] = (gradient * steps).sum(over)
        for back in range(1, len(taps)):
            later, earlier = gradient[:, back:], steps[:, :-back]
            of_steps[:, :-back].addcmul_(later, _taps_of_later(taps[-1 - back], back))
            _taps_of_later(of_taps[-1 - back], back)[:] = (later * earlier).sum(over)
        return of_steps, of_taps, gradient.sum(over).view(-1, gradient.shape[2])


def _taps_of_later(taps: Tensor, back: int) -> Tensor:
    """The taps (1, d) of all steps, or of those of (K, d) that have a step `back` before them."""
    return taps if len(taps) == 1 else taps[back:]


class ConvStream(nn.Module):
    """Convolution blocks of one modality (Table 6): x ← LN(x + Dropout(GELU(PW(DW₃(x)))))."""

    def __init__(self, config: UCFConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            _ConvBlock(config.dim, config.dropout) for _ in range(config.conv_blocks)
        )

    def forward(self, tokens: Tensor, mask: Tensor | None) -> Tensor:
        """Map (B, K, d) to (B, K, d); steps outside the mask count as zeros in convolutions."""
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


def visible_tokens(valid: Tensor) -> Tensor:
    """Causal attention mask (B, 1, L, L), true where row i may attend to column j: to itself and to
    earlier tokens that are `valid` (B, L), i.e. not padding."""
    length = valid.shape[1]
    earlier = torch.ones(length, length, dtype=torch.bool, device=valid.device).tril()
    diagonal = torch.eye(length, dtype=torch.bool, device=valid.device)
    return ((earlier & valid.unsqueeze(1)) | diagonal).unsqueeze(1)


def parent_targets(
    mask: Tensor,
    window: int,
    decay: float,
    previous_action: float,
) -> Tensor:
    """Target attention q (B, K, 3K) of the row that predicts a_t, over R_0, s_0, a_0, R_1, …

    Its parents are Ĝ_t and s_t with weight 1, s_{t−k} with weight decay^k for 1 ≤ k ≤ window, and
    a_{t−1} with weight `previous_action` (Table 7). Padded parents, where the mask (B, K) is false,
    are dropped, and the rest sums to one; rows of padded steps are zero.
    """
    steps = torch.arange(mask.shape[1], device=mask.device)
    back = steps.unsqueeze(1) - steps  # (K, K) t − j
    of_states = decay ** back.clamp(min=0) * ((back >= 0) & (back <= window))
    of_returns = (back == 0).float()
    of_actions = previous_action * (back == 1)
    weights = torch.stack([of_returns, of_states, of_actions], -1)
    valid = mask.unsqueeze(1) & mask.unsqueeze(2)
    targets = (weights * valid.unsqueeze(3)).flatten(2)
    return targets / targets.sum(-1, keepdim=True).clamp(min=EPSILON)


def mask_loss(attention: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    """Mean cross-entropy (nats) of attention (B, H, K, 3K), before dropout, against the causal
    parents (B, K, 3K) of `parent_targets` at the steps of the mask (B, K) (Eq. 5)."""
    entropy = -(targets.unsqueeze(1) * torch.log(attention + EPSILON)).sum(-1)  # (B, H, K)
    return entropy.mean(1)[mask].mean()


def _visible(mask: Tensor) -> Tensor:
    """(B, K, 3K): true where s_t may attend to a token: itself and valid tokens before it."""
    return visible_tokens(mask.repeat_interleave(3, dim=1))[:, 0, 1::3]
