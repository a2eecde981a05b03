"""What every sequence policy shares: configuration, normalisation, action loss, token embedding."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.heads import Head, head_from
from ucfrec.settings import Dropout, Width, require, settings_table

_CLIP = 10.0
"""Standardised states beyond this many standard deviations are clipped."""


Context = Annotated[int, Field(ge=1, le=4096)]
Layers = Annotated[int, Field(ge=1, le=128)]
Heads = Annotated[int, Field(ge=1, le=1024)]
Kernel = Annotated[int, Field(ge=1, le=4096)]
Timesteps = Annotated[int, Field(ge=1, le=10_000_000)]


@settings_table("policy")
class PolicyConfig:
    """Settings that every sequence policy has."""

    context: Context = 20
    """K, steps of history that a prediction sees."""
    dim: Width = 128
    """d, width of the model."""
    dropout: Dropout = 0.1
    """Share of the model's activations that is set to 0 in training."""
    return_scale: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    """Returns-to-go are divided by this; 0 stands for the largest absolute training return."""
    max_timestep: Timesteps = 1000
    """Rows of the timestep embedding; later steps share the last. 1 tells the model no time."""


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


def require_heads(config: PolicyConfig, heads: int) -> None:
    """Refuse attention heads that do not divide the model's width.

    Raises:
        SettingError: they do not.
    """
    require(
        config.dim % heads == 0,
        f"policy.heads is {heads}; it must divide policy.dim, which is {config.dim}",
        "policy.heads",
        "policy.dim",
    )


def interleave(returns: Tensor, states: Tensor, actions: Tensor) -> Tensor:
    """(B, K, d) three times to (B, 3K, d) in the order R_0, s_0, a_0, R_1, …"""
    batch, length, dim = returns.shape
    return torch.stack([returns, states, actions], dim=2).reshape(batch, 3 * length, dim)
