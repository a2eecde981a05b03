"""Base of all sequence policies: configuration, normalisation, action loss, token embedding."""

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
    """Settings of every sequence policy."""

    context: Context = 20
    """K, steps of history that a prediction uses."""
    dim: Width = 128
    """d, width of the model."""
    dropout: Dropout = 0.1
    """Share of the model's activations that is set to 0 in training."""
    return_scale: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    """Returns-to-go are divided by this; 0 selects the largest absolute training return."""
    max_timestep: Timesteps = 1000
    """Rows of the timestep embedding; later steps share the last row. 1 hides the time."""


class SequencePolicy(nn.Module, ABC):
    """Predicts a_t from returns-to-go and states up to t and actions before t.

    Subclasses implement `features`. Statistics of the data (normalisation, item embeddings) are
    buffers, so that a checkpoint is complete.
    """

    Config: ClassVar[type[PolicyConfig]] = PolicyConfig
    augmented: ClassVar[bool] = False
    """Whether the default of `augment.copies` is above 0 for this learner."""

    state_mean: Tensor
    state_std: Tensor
    return_scale: Tensor
    lowest_return_to_go: Tensor
    head: Head

    def __init__(self, config: PolicyConfig, sizes: Mapping[str, int]) -> None:
        """Args:
        config: settings, an instance of the class's `Config`.
        sizes: `state` S; `action` A, the size of an action vector or of an item's embedding; and
            `items`, the number of items, 0 if actions are vectors.
        """
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
        """The episodes to train on, derived from the training episodes; by default all, unchanged.

        Args:
            train: the training episodes.
            config: settings of the policy.
            folder: keeps intermediate results, so that a resumed run reuses them.
            seed: seed of every random draw.
        """
        return train

    def start_from(self, train: EpisodeStore) -> None:
        """Set buffers from the training episodes, before the first update."""

    @abstractmethod
    def features(self, windows: Windows) -> Tensor:
        """Inputs (B, K, d) of the action head, from normalised windows; row t ignores a_t."""

    def normalized(self, windows: Windows) -> Windows:
        """Standardised states, and returns-to-go divided by `return_scale`.

        Returns-to-go are first raised to the lowest value in the training data: after a session has
        reached its target return, they would otherwise leave the range of the training data.
        """
        states = ((windows.states - self.state_mean) / self.state_std).clamp(-_CLIP, _CLIP)
        returns_to_go = windows.returns_to_go.clamp(min=self.lowest_return_to_go)
        return replace(windows, states=states, returns_to_go=returns_to_go / self.return_scale)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean action loss over all steps of the windows, and scalars to log (Algorithm 6).

        In nats for items; for vectors, the squared error relative to the action's range.
        """
        features = self.features(self.normalized(windows))
        value = self.head.loss(features[windows.mask], windows.actions[windows.mask])
        return value, {"action_loss": value.detach()}

    def action_loss(self, windows: Windows) -> Tensor:
        """Mean action loss over the windows' last steps, the validation loss."""
        features = self.features(self.normalized(windows))
        return self.head.loss(features[:, -1], windows.actions[:, -1])

    def act(self, windows: Windows) -> Tensor:
        """Predictions at the last step: actions (B, A), or logits over items (B, n_items)."""
        return self.head.predict(self.features(self.normalized(windows))[:, -1])


class TokenEmbedding(nn.Module):
    """Tokens of returns-to-go, states and actions (Appendix G.3).

    One linear layer per modality, a shared learned timestep embedding, LayerNorm.
    """

    def __init__(self, config: PolicyConfig, state_size: int) -> None:
        super().__init__()
        self.embed_return: nn.Module = nn.Linear(1, config.dim)
        self.embed_state = nn.Linear(state_size, config.dim)
        self.embed_timestep = nn.Embedding(config.max_timestep, config.dim)
        self.norm = nn.LayerNorm(config.dim)

    def forward(self, windows: Windows, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens of returns-to-go, states and actions, (B, K, d) each.

        Args:
            windows: normalised.
            actions: (B, K, d) embedded actions.
        """
        last = self.embed_timestep.num_embeddings - 1
        time = self.embed_timestep(windows.timesteps.clamp(max=last))
        returns = self.embed_return(windows.returns_to_go.unsqueeze(-1))
        states = self.embed_state(windows.states)
        return self.norm(returns + time), self.norm(states + time), self.norm(actions + time)


def require_heads(config: PolicyConfig, heads: int) -> None:
    """Check that the number of attention heads divides the model's width.

    Raises:
        SettingError: it does not.
    """
    require(
        config.dim % heads == 0,
        f"policy.heads is {heads}; it must divide policy.dim, which is {config.dim}",
        "policy.heads",
        "policy.dim",
    )


def interleave(returns: Tensor, states: Tensor, actions: Tensor) -> Tensor:
    """Merge three tensors (B, K, d) into (B, 3K, d) in the order R_0, s_0, a_0, R_1, …"""
    batch, length, dim = returns.shape
    return torch.stack([returns, states, actions], dim=2).reshape(batch, 3 * length, dim)
