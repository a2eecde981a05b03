"""DT4Rec (Zhao et al., WWW 2023): returns as soft buckets, recurrent encoders, contrastive loss."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Heads, Layers, TokenEmbedding
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.policies.layers import recurrent
from ucfrec.settings import Dropout, Weight, settings_table


@settings_table("policy")
class DT4RecConfig(DTConfig):
    """Settings of DT4Rec; defaults are those of its public code, which has no contrastive loss."""

    layers: Layers = 2
    """Transformer blocks, each attention and a perceptron."""
    heads: Heads = 8
    """Attention heads per block; must divide `dim`."""
    buckets: Annotated[int, Field(ge=1, le=100_000)] = 100
    """Buckets of the reward prompt, spread evenly over the range of training returns-to-go."""
    recurrent_dropout: Dropout = 0.2
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
    logged return-to-go than with others. The public code shifts the next return by 0 to 7; here,
    the others are returns of other windows of the batch, which are on the scale of the data.
    Actions are one item or one vector, so the shared heads decode them. The recurrent decoder of
    the public code is not used; it starts from the encoding of the true action.
    """

    Config = DT4RecConfig
    config: DT4RecConfig
    embed: "PromptedEmbedding"

    def __init__(self, config: DT4RecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        self.embed = PromptedEmbedding(config, sizes["state"])

    def start_from(self, train: EpisodeStore) -> None:
        """Spread the buckets evenly over the range of training returns-to-go."""
        returns = torch.from_numpy(train.step_values(schema.RETURN_TO_GO, *train.all_steps()))
        low, high = returns.min() / self.return_scale, returns.max() / self.return_scale
        centres = self.embed.embed_return.centres
        centres.copy_(low + (high - low) * torch.linspace(0, 1, len(centres)))

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Action loss plus weighted contrastive loss over all steps, and scalars to log."""
        config, normalized = self.config, self.normalize(windows)
        tokens = self.tokens(normalized)
        features = self.attended(tokens, normalized.mask)[:, 1::3]
        imitation, scalars = self.imitation(features, normalized)
        if config.contrastive_weight == 0:
            return imitation, scalars
        contrast = self.contrastive_loss(normalized, tokens[1:], features)
        scalars["contrastive_loss"] = contrast.detach()
        return imitation + config.contrastive_weight * contrast, scalars

    def contrastive_loss(
        self, windows: Windows, encoded: tuple[Tensor, Tensor], features: Tensor
    ) -> Tensor:
        """InfoNCE (nats) of the logged return against those of other windows, mean over all steps.

        Args:
            windows: B normalised windows.
            encoded: their tokens s_t and a_t, (B, K, d) each, which returns do not change.
            features: (B, K, d) their features.
        """
        config, mask = self.config, windows.mask
        actions = self.head.embed(windows.actions)[mask]
        scores = [F.cosine_similarity(features[mask], actions, dim=-1)]
        for _ in range(config.negatives):
            order = torch.randperm(len(mask), device=mask.device)
            both_valid = mask & mask[order]
            returns = torch.where(both_valid, windows.returns_to_go[order], windows.returns_to_go)
            prompts = self.embed.returns(replace(windows, returns_to_go=returns))
            negative = self.attended((prompts, *encoded), mask)[:, 1::3]
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
        time = self._time(windows)
        return self.returns(windows), self.norm(states + time), self.norm(actions + time)

    def returns(self, windows: Windows) -> Tensor:
        """Tokens of returns-to-go alone, (B, K, d)."""
        prompts = self.embed_return(windows.returns_to_go.unsqueeze(-1))
        return self.norm(prompts + self._time(windows))  # type: ignore[no-any-return]

    def _time(self, windows: Windows) -> Tensor:
        last = self.embed_timestep.num_embeddings - 1
        return self.embed_timestep(windows.timesteps.clamp(max=last))  # type: ignore[no-any-return]


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
