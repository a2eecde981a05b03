"""Decision Transformer (Chen et al., 2021), a baseline and the backbone of `w/o Arch`; variants.

CDT4Rec (Wang et al., SIGIR 2023) also estimates the reward. DT4Rec (Zhao et al., WWW 2023) has
returns as soft buckets, recurrent encoders and a contrastive loss.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema, settings
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import (
    Heads,
    Layers,
    PolicyConfig,
    SequencePolicy,
    embed_time,
    init_linear,
    recurrent,
    require_heads,
)
from ucfrec.policies.ucf import Dropout, TokenEmbedding, draw_mask, interleave, visible_tokens
from ucfrec.settings import Weight, settings_table


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
    Weights are those of the official code without its unused prediction heads and word table."""

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
        return self.attend(self.tokens(windows), windows.mask, slice(1, None, 3))

    def tokens(self, windows: Windows) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens R_t, s_t and a_t, (B, K, d) each, from normalised windows."""
        return self.embed(windows, self.head.embed(windows.actions))  # type: ignore[no-any-return]

    def attend(
        self,
        tokens: tuple[Tensor, Tensor, Tensor],
        mask: Tensor,
        rows: slice | None = None,
    ) -> Tensor:
        """Outputs (B, 3K, d) at R_0, s_0, a_0, R_1, … or `rows`; `mask` (B, K) excludes padding."""
        hidden = self.dropout(interleave(tokens))
        visible = visible_tokens(mask.repeat_interleave(3, dim=1))
        return self.final_norm(pass_rows(self.blocks, hidden, visible, rows))  # type: ignore[no-any-return]

    def last_features(self, windows: Windows) -> Tensor:
        """Row K − 1 of `features`, (B, d), without what the last block has for other tokens."""
        tokens = self.tokens(windows)
        return self.attend(tokens, windows.mask, slice(-2, -1))[:, 0]


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
        self.mlp = nn.Sequential(
            nn.Linear(dim, 4 * dim),
            nn.ReLU(),
            nn.Linear(4 * dim, dim),
        )
        self.dropout = Dropout(config.dropout)

    def forward(
        self,
        hidden: Tensor,
        visible: Tensor,
        rows: slice | None = None,
    ) -> Tensor:
        """Map (B, L, d) to (B, L, d), or to the `rows` (B, M, d) of it; `visible` (B, 1, L, L)
        comes from `visible_tokens`."""
        normed = self.attention_norm(hidden)
        if rows is None:
            query, key, value = self.query_key_value(normed).chunk(3, dim=-1)
        else:
            layer, dim = self.query_key_value, hidden.shape[-1]
            query = F.linear(normed[:, rows], layer.weight[:dim], layer.bias[:dim])
            key_value = F.linear(normed, layer.weight[dim:], layer.bias[dim:])
            key, value = key_value.chunk(2, dim=-1)
            hidden, visible = hidden[:, rows], visible[:, :, rows]
        rate = self.rate if self.training else 0.0
        mixed = attend(query, key, value, visible, self.heads, rate)
        hidden = hidden + self.dropout(self.out(mixed))
        return hidden + self.dropout(self.mlp(self.mlp_norm(hidden)))  # type: ignore[no-any-return]


def pass_rows(
    blocks: Iterable[nn.Module],
    hidden: Tensor,
    visible: Tensor,
    rows: slice | None,
) -> Tensor:
    """The `rows` (B, M, d), or all, of what `Block`s make of tokens (B, L, d)."""
    *first_blocks, last = blocks
    for block in first_blocks:
        hidden = block(hidden, visible)
    return last(hidden, visible, rows)  # type: ignore[no-any-return]


def attend(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    visible: Tensor,
    heads: int,
    dropout: float = 0.0,
) -> Tensor:
    """Scaled dot-product attention (B, M, d) of queries (B, M, d) to keys and values (B, L, d) that
    are `visible` (B, 1, M, L), some in each row; drops weights as `Dropout`."""
    size = query.shape[0], -1, heads, query.shape[2] // heads
    # (B, L, d) -> (B, H, L, d/H)
    split = (x.view(size).transpose(1, 2) for x in (query, key, value))
    query, key, value = split
    if dropout == 0 or query.device.type != "cpu":
        mixed = F.scaled_dot_product_attention(query, key, value, visible, dropout)
    else:
        scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-2, -1)
        weights = scores.masked_fill(~visible, -torch.inf).softmax(-1)
        mixed = torch.matmul(weights * draw_mask(weights.shape, dropout), value)
    return mixed.transpose(1, 2).flatten(2)


@settings_table("policy")
class CDT4RecConfig(DTConfig):
    """Settings of CDT4Rec; the backbone is DT, as in its public code."""

    reward_weight: Weight = 0.5
    """Weight of the squared error of the standardised reward; 0 gives DT. The public code adds both
    losses unweighted and does not standardise rewards."""


class CDT4RecPolicy(DTPolicy):
    """DT with a causal reward estimator on its hidden states.

    The hidden state of s_t attends to those of a_0, …, a_t (keys and values). The result and the
    state together predict r_t, and the error also trains the shared blocks. The public code
    concatenates the hidden states of a_t and s_t instead, and never trains its reward head.
    """

    Config = CDT4RecConfig
    config: CDT4RecConfig
    reward_mean: Tensor
    reward_std: Tensor

    def __init__(self, config: CDT4RecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        dim = config.dim
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_std", torch.ones(()))
        self.attention = nn.MultiheadAttention(dim, config.heads, batch_first=True)
        self.estimate = nn.Sequential(
            nn.Linear(2 * dim, dim),
            nn.ReLU(),
            nn.Linear(dim, 1),
        )

    def start_from(self, train: EpisodeStore) -> None:
        """Set the mean and standard deviation of the training rewards."""
        rewards = torch.from_numpy(train.column(schema.REWARD))
        self.reward_mean.copy_(rewards.mean())
        self.reward_std.copy_(rewards.std(correction=0).clamp(min=1e-6))

    def estimate_rewards(self, hidden: Tensor, mask: Tensor) -> Tensor:
        """Estimates (B, K) of the logged actions' standardised rewards, from outputs (B, 3K, d) of
        `attend`; the mask (B, K) is false at padding."""
        states, actions = hidden[:, 1::3], hidden[:, 2::3]
        hidden_keys = ~visible_tokens(mask)[:, 0]  # (B, K, K)
        attended, _ = self.attention(
            states,
            actions,
            actions,
            attn_mask=hidden_keys.repeat_interleave(self.config.heads, dim=0),
            need_weights=False,
        )
        return self.estimate(torch.cat([attended, states], dim=-1)).squeeze(-1)  # type: ignore[no-any-return]

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Action loss plus weighted reward loss over all steps, and scalars to log."""
        mask, normalized = windows.mask, self.normalize(windows)
        hidden = self.attend(self.tokens(normalized), mask)
        imitation, scalars = self.imitation(hidden[:, 1::3], normalized)
        rewards = (windows.rewards - self.reward_mean) / self.reward_std
        reward_loss = (self.estimate_rewards(hidden, mask) - rewards).square()[mask].mean()
        scalars["reward_loss"] = reward_loss.detach()
        return imitation + self.config.reward_weight * reward_loss, scalars


@settings_table("policy")
class DT4RecConfig(DTConfig):
    """Settings of DT4Rec; defaults are those of its public code, which has no contrastive loss."""

    layers: Layers = 2
    """Transformer blocks, each attention and a perceptron."""
    heads: Heads = 8
    """Attention heads per block; must divide `dim`."""
    buckets: Annotated[int, Field(ge=1, le=100_000)] = 100
    """Buckets of the reward prompt, spread evenly over the range of training returns-to-go."""
    recurrent_dropout: settings.Dropout = 0.2
    """Dropout between the two layers of the recurrent encoders."""
    negatives: Annotated[int, Field(ge=1, le=1000)] = 4
    """Wrong returns-to-go per window in the contrastive loss, each of which costs a forward pass of
    the Transformer; the paper has 8."""
    contrastive_weight: Weight = 0.1
    """Weight of the contrastive loss; 0 gives the loss of the public code."""
    temperature: Annotated[float, Field(gt=0, le=1000)] = 0.07
    """Temperature of the contrastive loss, which divides the similarities."""


class DT4RecPolicy(DTPolicy):
    """DT whose tokens come from a reward prompt and from recurrent encoders.

    The contrastive loss draws the features of a step closer to the embedding of its action with the
    logged return-to-go than with those of other windows of the batch; the public code shifts the
    next return by 0 to 7. The shared heads decode the one item or vector of a step, not the public
    code's recurrent decoder, which starts from the encoding of the true action.
    """

    Config = DT4RecConfig
    config: DT4RecConfig
    embed: "PromptedEmbedding"

    def __init__(self, config: DT4RecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed = PromptedEmbedding(config, sizes["state"])

    def start_from(self, train: EpisodeStore) -> None:
        """Spread the buckets evenly over the range of training returns-to-go."""
        returns = torch.from_numpy(train.column(schema.RETURN_TO_GO))
        low, high = returns.min() / self.return_scale, returns.max() / self.return_scale
        centres = self.embed.embed_return.centres
        centres.copy_(low + (high - low) * torch.linspace(0, 1, len(centres)))

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Action loss plus weighted contrastive loss over all steps, and scalars to log."""
        config, normalized = self.config, self.normalize(windows)
        tokens = self.tokens(normalized)
        features = self.attend(tokens, normalized.mask)[:, 1::3]
        imitation, scalars = self.imitation(features, normalized)
        if config.contrastive_weight == 0:
            return imitation, scalars
        contrast = self.contrastive_loss(normalized, tokens[1:], features)
        scalars["contrastive_loss"] = contrast.detach()
        return imitation + config.contrastive_weight * contrast, scalars

    def contrastive_loss(
        self,
        windows: Windows,
        encoded: tuple[Tensor, Tensor],
        features: Tensor,
    ) -> Tensor:
        """InfoNCE (nats) of the logged return against those of other windows, mean over all steps
        of normalised windows with `features` (B, K, d) and `encoded` tokens s_t and a_t."""
        config, mask = self.config, windows.mask
        actions = self.head.embed(windows.actions)[mask]
        scores = [F.cosine_similarity(features[mask], actions, dim=-1)]
        for _ in range(config.negatives):
            order = torch.randperm(len(mask), device=mask.device)
            both_valid = mask & mask[order]
            returns = torch.where(both_valid, windows.returns_to_go[order], windows.returns_to_go)
            prompts = self.embed.returns(replace(windows, returns_to_go=returns))
            negative = self.attend((prompts, *encoded), mask)[:, 1::3]
            score = F.cosine_similarity(negative[mask], actions, dim=-1)
            # An equal return-to-go is not a negative.
            same = (returns == windows.returns_to_go)[mask]
            scores.append(score.masked_fill(same, -torch.inf))
        logits = torch.stack(scores, dim=-1) / config.temperature  # (M, 1 + negatives)
        return F.cross_entropy(logits, logits.new_zeros(len(logits), dtype=torch.int64))


class PromptedEmbedding(TokenEmbedding):
    """Tokens: returns from the reward prompt, states and actions from two-layer GRUs."""

    embed_return: "RewardPrompt"

    def __init__(self, config: DT4RecConfig, state_size: int) -> None:
        super().__init__(config, state_size)
        self.embed_return = RewardPrompt(config)
        self.states, self.actions = (
            nn.GRU(config.dim, config.dim, 2, batch_first=True, dropout=config.recurrent_dropout)
            for _ in range(2)
        )

    def forward(self, windows: Windows, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens of returns-to-go, states and actions, (B, K, d) each; see `TokenEmbedding`."""
        states = recurrent(self.states, self.embed_state(windows.states), windows.mask)
        actions = recurrent(self.actions, actions, windows.mask)
        time = embed_time(self.embed_timestep, windows)
        return self.returns(windows), self.norm(states + time), self.norm(actions + time)

    def returns(self, windows: Windows) -> Tensor:
        """Tokens of returns-to-go alone, (B, K, d)."""
        prompts = self.embed_return(windows.returns_to_go.unsqueeze(-1))
        return self.norm(prompts + embed_time(self.embed_timestep, windows))  # type: ignore[no-any-return]


class RewardPrompt(nn.Module):
    """Embeds a return as a soft mixture of buckets: similar returns have similar embeddings.

    h = LeakyReLU(w R), z = softmax(W h + h); the embedding is Σ_b z_b M_b, where M_b is a linear
    map of the centre of bucket b.
    """

    centres: Tensor

    def __init__(self, config: DT4RecConfig) -> None:
        super().__init__()
        self.register_buffer("centres", torch.linspace(0, 1, config.buckets, device="cpu"))
        self.weight = nn.Linear(1, config.buckets, bias=False)
        self.mix = nn.Linear(config.buckets, config.buckets, bias=False)
        self.embed_centre = nn.Linear(1, config.dim)

    def forward(self, returns: Tensor) -> Tensor:
        """Embed scaled returns-to-go (B, K, 1) as (B, K, d)."""
        hidden = F.leaky_relu(self.weight(returns))
        shares = (self.mix(hidden) + hidden).softmax(-1)  # (B, K, buckets)
        return shares @ self.embed_centre(self.centres.unsqueeze(-1))  # type: ignore[no-any-return]
