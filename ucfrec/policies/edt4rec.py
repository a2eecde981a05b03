"""EDT4Rec (Chen et al., 2024): a stochastic head kept varied, and returns stitched by CQL."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Context, PolicyConfig
from ucfrec.policies.cql import CQLConfig, relabelled
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.policies.heads import ItemHead, VectorHead
from ucfrec.settings import Count, Weight, settings_table


@settings_table("policy")
class EDT4RecConfig(DTConfig):
    """Settings of EDT4Rec, which has no public code: Online DT's where the paper is silent."""

    context: Context = 2
    """K, steps of history that a prediction sees."""
    vector_entropy: Annotated[float, Field(ge=-1000, le=1000)] = -1.0
    """β, lowest entropy (nats) for every dimension of a vector action."""
    item_entropy: Annotated[float, Field(ge=-1000, le=1)] = 0.3
    """The same of items, as a share of the entropy of the uniform choice; below 0 never binds."""
    multiplier: Annotated[float, Field(gt=0, le=1e6)] = 0.1
    """λ of the entropy constraint before the first step."""
    relabel: bool = True
    """Raise returns-to-go to what CQL says was within reach."""
    cql_steps: Count = 2000
    """Updates of CQL's network, where returns-to-go are raised."""
    cql_weight: Weight = 1.0
    """α, how strongly CQL presses unseen actions down."""


class EDT4RecPolicy(DTPolicy):
    """DT with a stochastic head under max −J − λH and λ ≥ 0, on relabelled returns.

    The policy minimises the negative log-likelihood subject to an entropy of at least β; λ descends
    λ(H − β) in the same step instead of alternating with it. It acts by its mode.
    """

    Config = EDT4RecConfig
    config: EDT4RecConfig

    def __init__(self, config: EDT4RecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        if isinstance(self.head, VectorHead):
            self.head = GaussianHead(config.dim, sizes["action"])
            self.floor = config.vector_entropy * sizes["action"]
        else:
            self.floor = config.item_entropy * math.log(sizes["items"])
        self.log_multiplier = nn.Parameter(torch.tensor(config.multiplier).log())

    @classmethod
    def training_view(
        cls, train: EpisodeStore, config: PolicyConfig, folder: Path, seed: int
    ) -> EpisodeStore:
        """The episodes with relabelled returns-to-go."""
        assert isinstance(config, EDT4RecConfig)
        if not config.relabel:
            return train
        cql = CQLConfig(steps=config.cql_steps, weight=config.cql_weight)
        return relabelled(train, cql, folder, seed)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative log-likelihood and the two sides of the entropy constraint."""
        normalized = self.normalized(_consistent(windows))
        features = self.features(normalized)[windows.mask]
        action_loss = self.head.loss(features, windows.actions[windows.mask])
        entropy = _entropy(self.head, features)
        multiplier = self.log_multiplier.exp()
        constraint = multiplier * (entropy.detach() - self.floor) - multiplier.detach() * entropy
        return action_loss + constraint, {
            "action_loss": action_loss.detach(),
            "entropy": entropy.detach(),
            "multiplier": multiplier.detach(),
        }


class GaussianHead(VectorHead):
    """A diagonal Gaussian about the deterministic head's action, in shares of the action's range.

    The loss is its negative log-likelihood a step.
    """

    def __init__(self, dim: int, size: int) -> None:
        super().__init__(dim, size)
        self.log_deviation = nn.Linear(dim, size)

    def deviations(self, features: Tensor) -> Tensor:
        """Log standard deviations, (..., d) to (..., A), kept where squares stay finite."""
        return self.log_deviation(features).clamp(-5.0, 2.0)  # type: ignore[no-any-return]

    def loss(self, features: Tensor, actions: Tensor) -> Tensor:
        """Mean negative log-likelihood over M steps: features (M, d), actions (M, A)."""
        log_deviation = self.deviations(features)
        miss = (actions - self.predict(features)) / self.scale / log_deviation.exp()
        nats = 0.5 * miss.square() + log_deviation + 0.5 * math.log(2 * math.pi)
        return nats.sum(-1).mean()


def _entropy(head: nn.Module, features: Tensor) -> Tensor:
    """Mean entropy (nats) of the head's distribution over M steps, features (M, d)."""
    if isinstance(head, GaussianHead):
        return (head.deviations(features) + 0.5 * math.log(2 * math.pi * math.e)).sum(-1).mean()
    assert isinstance(head, ItemHead)
    log_probabilities = head.predict(features).log_softmax(-1)
    return -(log_probabilities.exp() * log_probabilities).sum(-1).mean()


def _consistent(windows: Windows) -> Windows:
    """Returns-to-go that fall by the reward of each step, down to the last step's own.

    Relabelled returns of neighbouring steps need not differ by the reward between them; when
    acting, they always do.
    """
    rewards = windows.rewards[:, :-1].flip(1).cumsum(1).flip(1)  # r_t + … + r_{last − 1}
    last = windows.returns_to_go[:, -1:]
    returns = torch.cat([last + rewards, last], dim=1).masked_fill(~windows.mask, 0.0)
    return replace(windows, returns_to_go=returns)
