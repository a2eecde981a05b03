"""Sequence policies: what they share, and UCF's hybrid causal architecture (paper section 3.2)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.heads import Head, head_from
from ucfrec.losses import mask_loss, masked_mean, parent_targets
from ucfrec.store import EpisodeStore
from ucfrec.windows import Windows

_CLIP = 10.0
"""Standardised states beyond this many standard deviations are clipped."""


@dataclass(frozen=True)
class PolicyConfig:
    """What every sequence policy has."""

    context: int = 20
    """K, steps of history that a prediction sees."""
    dim: int = 128
    """d, width of the model."""
    dropout: float = 0.1
    return_scale: float = 0.0
    """Returns-to-go are divided by this; 0 stands for the largest absolute training return."""
    max_timestep: int = 1000
    """Rows of the timestep embedding; later steps share the last."""


class SequencePolicy(nn.Module, ABC):
    """Predicts a_t from returns-to-go and states up to t and actions before t.

    Subclasses give `features`; everything about data (normalisation, item embeddings) is held in
    buffers, so that a checkpoint is complete.
    """

    Config: ClassVar[type[PolicyConfig]] = PolicyConfig
    augmented: ClassVar[bool] = False
    """Whether counterfactual copies join the training data unless configured otherwise."""

    state_mean: Tensor
    state_std: Tensor
    return_scale: Tensor
    lowest_return_to_go: Tensor
    head: Head

    def __init__(self, config: PolicyConfig, sizes: Mapping[str, int]) -> None:
        """Build for `sizes`: `state` S, `action` A (of an item: its embedding's size), `items`
        (0 where actions are vectors)."""
        super().__init__()
        self.config = config
        self.register_buffer("state_mean", torch.zeros(sizes["state"]))
        self.register_buffer("state_std", torch.ones(sizes["state"]))
        self.register_buffer("return_scale", torch.ones(()))
        self.register_buffer("lowest_return_to_go", torch.tensor(-torch.inf))
        self.head = head_from(sizes, config.dim)

    @classmethod
    def training_view(
        cls, train: EpisodeStore, config: PolicyConfig, folder: Path, seed: int
    ) -> EpisodeStore:
        """What the policy learns from, of the training episodes: all of them, unless it says more.

        Args:
            folder: where anything that this takes to compute is kept, for a run that is resumed.
        """
        return train

    def start_from(self, train: EpisodeStore) -> None:
        """Take over what the architecture must know of its training data before the first step."""

    @abstractmethod
    def features(self, windows: Windows) -> Tensor:
        """What predicts the actions, (B, K, d), from normalised windows; row t sees no a_t."""

    def normalized(self, windows: Windows) -> Windows:
        """Standardised states; returns-to-go, scaled, none below the lowest of the training data.

        A session that has earned its target would else be asked for less than nothing, and that is
        what the policy would then aim at.
        """
        states = ((windows.states - self.state_mean) / self.state_std).clamp(-_CLIP, _CLIP)
        asked = windows.returns_to_go.clamp(min=self.lowest_return_to_go)
        return replace(windows, states=states, returns_to_go=asked / self.return_scale)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Action loss over all steps of the windows, and scalars to log (Algorithm 6)."""
        features = self.features(self.normalized(windows))
        value = self.head.loss(features[windows.mask], windows.actions[windows.mask])
        return value, {"action_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """The action loss at each window's last step: what validation compares."""
        features = self.features(self.normalized(windows))
        return self.head.loss(features[:, -1], windows.actions[:, -1])

    def act(self, windows: Windows) -> Tensor:
        """Predictions at the last step: actions (B, A), or logits over items (B, n_items)."""
        return self.head.predict(self.features(self.normalized(windows))[:, -1])


class TokenEmbedding(nn.Module):
    """Returns-to-go, states and actions as tokens: one linear layer a modality, a shared learned
    timestep embedding, LayerNorm (Appendix G.3)."""

    def __init__(self, config: PolicyConfig, state_size: int) -> None:
        super().__init__()
        self.embed_return: nn.Module = nn.Linear(1, config.dim)
        self.embed_state = nn.Linear(state_size, config.dim)
        self.embed_timestep = nn.Embedding(config.max_timestep, config.dim)
        self.norm = nn.LayerNorm(config.dim)

    def forward(self, windows: Windows, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens of each modality, (B, K, d), given embedded actions (B, K, d)."""
        last = self.embed_timestep.num_embeddings - 1
        time = self.embed_timestep(windows.timesteps.clamp(max=last))
        returns = self.embed_return(windows.returns_to_go.unsqueeze(-1))
        states = self.embed_state(windows.states)
        return self.norm(returns + time), self.norm(states + time), self.norm(actions + time)


def interleave(returns: Tensor, states: Tensor, actions: Tensor) -> Tensor:
    """(B, K, d) three times to (B, 3K, d) in the order R_0, s_0, a_0, R_1, …"""
    batch, length, dim = returns.shape
    return torch.stack([returns, states, actions], dim=2).reshape(batch, 3 * length, dim)


@dataclass(frozen=True)
class UCFConfig(PolicyConfig):
    """UCF's hybrid policy; defaults are the paper's Tables 6 to 8, but for λ and the weight of
    a_{t−1}, which were chosen on validation episodes (`benchmarks/LOG.md`)."""

    conv_blocks: int = 2
    heads: int = 2
    lambda_mask: float = 0.0
    """λ, weight of the mask loss; any cost return in both worlds where it was swept."""
    parent_window: int = 2
    """w, how many earlier states count as parents."""
    parent_decay: float = 0.6
    """Weight of s_{t−k} is this to the power k."""
    parent_action: float = 0.3
    """Weight of a_{t−1} as a parent."""


class UCFPolicy(SequencePolicy):
    """One convolution stream a modality, one attention block supervised towards causal parents.

    Sources: section 3.2, Appendix G.3, Tables 6 to 8. Only the rows that predict an action (query
    s_t) pass through the attention block; keys and values are all 3K tokens.
    """

    Config = UCFConfig
    augmented = True
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
            nn.Linear(dim, 4 * dim), nn.GELU(), nn.Linear(4 * dim, dim), nn.Dropout(config.dropout)
        )
        self.final_norm = nn.LayerNorm(dim)

    def features(self, windows: Windows) -> Tensor:
        """(B, K, d) at the s_t tokens."""
        return self.attend(windows)[0]

    def attend(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """Features (B, K, d), and the attention (B, H, K, 3K) that they came from."""
        tokens = self.embed(windows, self.head.embed(windows.actions))
        streams = (self.return_stream, self.state_stream, self.action_stream)
        returns, states, actions = (
            stream(token, windows.mask) for stream, token in zip(streams, tokens, strict=True)
        )
        # Concatenating what step t has revealed so far ([R, 0, 0], [R, s, 0], [R, s, a]) and one
        # linear layer is a running sum of the layer's three blocks.
        of_return, of_state, of_action = self.fuse.weight.chunk(3, dim=1)
        revealed = F.linear(returns, of_return, self.fuse.bias)
        fused_returns = self.fuse_norm(returns + revealed)
        revealed = revealed + F.linear(states, of_state)
        fused_states = self.fuse_norm(states + revealed)
        revealed = revealed + F.linear(actions, of_action)
        fused_actions = self.fuse_norm(actions + revealed)

        tokens = interleave(fused_returns, fused_states, fused_actions)
        attended, attention = self.attention(fused_states, tokens, windows.mask)
        hidden = fused_states + attended
        hidden = hidden + self.mlp(self.mlp_norm(hidden))
        return self.final_norm(hidden), attention

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """L_action + λ L_mask (Eq. 5, Algorithm 6)."""
        config, mask = self.config, windows.mask
        features, attention = self.attend(self.normalized(windows))
        action_loss = self.head.loss(features[mask], windows.actions[mask])
        targets = parent_targets(
            mask, config.parent_window, config.parent_decay, config.parent_action
        )
        supervision = mask_loss(attention, targets, mask)
        on_parents = (attention.mean(1) * (targets > 0)).sum(-1)
        return action_loss + config.lambda_mask * supervision, {
            "action_loss": action_loss.detach(),
            "mask_loss": supervision.detach(),
            "attention_on_parents": masked_mean(on_parents.detach(), mask),
        }


class ConvStream(nn.Module):
    """Convolution blocks of one modality (Table 6): x ← LN(x + Dropout(GELU(PW(DW₃(x)))))."""

    def __init__(self, config: UCFConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_ConvBlock(config) for _ in range(config.conv_blocks))

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """(B, K, d) to (B, K, d); padded steps are zeroed before every convolution."""
        keep = mask.unsqueeze(-1)
        for block in self.blocks:
            tokens = block(tokens.masked_fill(~keep, 0.0))
        return tokens


class _ConvBlock(nn.Module):
    def __init__(self, config: UCFConfig) -> None:
        super().__init__()
        dim = config.dim
        self.depthwise = nn.Conv1d(dim, dim, kernel_size=3, groups=dim)
        self.pointwise = nn.Linear(dim, dim)
        self.dropout = nn.Dropout(config.dropout)
        self.norm = nn.LayerNorm(dim)

    def forward(self, tokens: Tensor) -> Tensor:
        # (B, K, d) -> (B, d, 2 + K) -> (B, K, d): the output at t sees t − 2 to t.
        local = self.depthwise(F.pad(tokens.transpose(1, 2), (2, 0))).transpose(1, 2)
        return self.norm(tokens + self.dropout(F.gelu(self.pointwise(local))))  # type: ignore[no-any-return]


class SupervisedAttention(nn.Module):
    """Multi-head attention from the s_t tokens to all tokens revealed by then (Table 7)."""

    def __init__(self, config: UCFConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm = nn.LayerNorm(config.dim)
        self.query = nn.Linear(config.dim, config.dim)
        self.key_value = nn.Linear(config.dim, 2 * config.dim)
        self.out = nn.Linear(config.dim, config.dim)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, states: Tensor, tokens: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Attend from `states` (B, K, d) over `tokens` (B, 3K, d).

        Returns:
            Output (B, K, d), and probabilities (B, H, K, 3K) before dropout; each row sums to one,
            and a padded row looks at itself only.
        """
        batch, length, dim = states.shape

        def split(x: Tensor) -> Tensor:  # (B, L, d) -> (B, H, L, d/H)
            return x.view(batch, -1, self.heads, dim // self.heads).transpose(1, 2)

        query = split(self.query(self.norm(states)))
        key, value = map(split, self.key_value(self.norm(tokens)).chunk(2, dim=-1))
        scores = query @ key.transpose(-2, -1) / (dim // self.heads) ** 0.5  # (B, H, K, 3K)
        scores = scores.masked_fill(~_visible(mask).unsqueeze(1), -torch.inf)
        attention = scores.softmax(-1)
        mixed = (self.dropout(attention) @ value).transpose(1, 2).reshape(batch, length, dim)
        return self.dropout(self.out(mixed)), attention


def _visible(mask: Tensor) -> Tensor:
    """(B, K, 3K): which tokens the row of s_t may see, those up to s_t that are not padding."""
    length = mask.shape[1]
    row = 3 * torch.arange(length, device=mask.device).unsqueeze(1) + 1
    token = torch.arange(3 * length, device=mask.device)
    there = mask.repeat_interleave(3, dim=1).unsqueeze(1)
    return (token <= row) & there | (token == row)
