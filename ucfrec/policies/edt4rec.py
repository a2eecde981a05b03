"""EDT4Rec (Chen et al., 2024): a stochastic head with an entropy bound, CQL-relabelled returns."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.episodes.exposure import Exposed
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import Context, PolicyConfig, Returns
from ucfrec.policies.cql import CQLConfig, relabelled
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.policies.heads import ItemHead, VectorHead
from ucfrec.settings import Count, Weight, require, settings_table


@settings_table("policy")
class EDT4RecConfig(DTConfig):
    """Settings of EDT4Rec, which has no public code; those of Online DT if the paper gives none."""

    context: Context = 2
    """K, steps of history that a prediction uses."""
    vector_entropy: Annotated[float, Field(ge=-1000, le=1000)] = -1.0
    """β, lowest entropy (nats) per dimension of a vector action."""
    item_entropy: Annotated[float, Field(ge=-1000, le=1)] = 0.3
    """Lowest entropy for items, as a share of the uniform distribution's; below 0 has no effect."""
    multiplier: Annotated[float, Field(gt=0, le=1e6)] = 0.1
    """Initial value of λ, the multiplier of the entropy constraint."""
    relabel: bool = True
    """Whether returns-to-go are raised by CQL's state values."""
    cql_steps: Count = 2000
    """Updates of CQL's network, if `relabel` is true."""
    return_to_go: Returns = "session"
    """What returns-to-go count, as for all policies; relabelling needs those of sessions."""
    cql_weight: Weight = 1.0
    """α, weight of CQL's conservative term, which lowers the values of unlogged actions."""

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        super().__post_init__()
        require(
            not self.relabel or self.return_to_go == "session",
            f"policy.return_to_go is {self.return_to_go!r}; policy.relabel raises the returns of "
            "whole sessions, so set it to false or take the returns-to-go of the session",
            "policy.return_to_go",
            "policy.relabel",
        )


class EDT4RecPolicy(DTPolicy):
    """DT with a stochastic head and a lower bound on its entropy H, on relabelled returns.

    The policy minimises the negative log-likelihood subject to H ≥ β. The multiplier λ ≥ 0 descends
    λ(H − β) in the same update instead of an alternating one. Actions are the distribution's mode.
    """

    Config = EDT4RecConfig
    config: EDT4RecConfig

    def __init__(self, config: EDT4RecConfig, sizes: Mapping[str, int]) -> None:
        super().__init__(config, sizes)
        if isinstance(self.head, VectorHead):
            self.head = GaussianHead(config.dim, sizes["action"])
            self.least_entropy = config.vector_entropy * sizes["action"]
        else:
            self.least_entropy = config.item_entropy * math.log(sizes["items"])
        self.log_multiplier = nn.Parameter(torch.tensor(config.multiplier).log())

    @classmethod
    def training_view(
        cls, train: EpisodeStore, config: PolicyConfig, folder: Path, seed: int
    ) -> EpisodeStore:
        """The episodes with returns-to-go raised by CQL; as logged if `relabel` is false."""
        assert isinstance(config, EDT4RecConfig)
        train = super().training_view(train, config, folder, seed)
        if not config.relabel:
            return train
        cql = CQLConfig(steps=config.cql_steps, weight=config.cql_weight)
        return relabelled(train, cql, folder, seed)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative log-likelihood (nats) plus the entropy constraint's terms for λ and policy."""
        normalized = self.normalized(_consistent(windows))
        features = self.features(normalized)
        imitation, scalars = self.imitation(features, normalized)
        exposed = self.exposed(normalized)
        exposed = None if exposed is None else exposed.select(windows.mask.flatten())
        entropy = _entropy(self.head, features[windows.mask], exposed)
        multiplier = self.log_multiplier.exp()
        constraint = (
            multiplier * (entropy.detach() - self.least_entropy) - multiplier.detach() * entropy
        )
        return imitation + constraint, {
            **scalars,
            "entropy": entropy.detach(),
            "multiplier": multiplier.detach(),
        }


class GaussianHead(VectorHead):
    """A diagonal Gaussian whose mean is the action of `VectorHead`, in units of `scale`."""

    def __init__(self, dim: int, size: int) -> None:
        super().__init__(dim, size)
        self.log_deviation = nn.Linear(dim, size)

    def deviations(self, features: Tensor) -> Tensor:
        """Log standard deviations (..., A) from features (..., d), clamped to [−5, 2]."""
        return self.log_deviation(features).clamp(-5.0, 2.0)  # type: ignore[no-any-return]

    def loss(self, features: Tensor, actions: Tensor, exposed: None = None) -> Tensor:
        """Mean negative log-likelihood (nats) over M steps: features (M, d), actions (M, A)."""
        return self.losses(features, actions).mean()

    def losses(self, features: Tensor, actions: Tensor, exposed: None = None) -> Tensor:
        """Negative log-likelihood (nats) of each of M steps, (M,)."""
        log_deviation = self.deviations(features)
        error = (actions - self.predict(features)) / self.scale / log_deviation.exp()
        nats = 0.5 * error.square() + log_deviation + 0.5 * math.log(2 * math.pi)
        return nats.sum(-1)


def _entropy(head: nn.Module, features: Tensor, exposed: Exposed | None) -> Tensor:
    """Mean entropy (nats) of the head's distribution over M steps, features (M, d)."""
    if isinstance(head, GaussianHead):
        return (head.deviations(features) + 0.5 * math.log(2 * math.pi * math.e)).sum(-1).mean()
    assert isinstance(head, ItemHead)
    return head.entropy(features, exposed)


def _consistent(windows: Windows) -> Windows:
    """The windows with returns-to-go that decrease by each step's reward to the last step's value.

    Relabelled returns-to-go of adjacent steps need not differ by the reward between them; those
    used in acting always do.
    """
    rewards = windows.rewards[:, :-1].flip(1).cumsum(1).flip(1)  # r_t + … + r_{last − 1}
    last = windows.returns_to_go[:, -1:]
    returns = torch.cat([last + rewards, last], dim=1).masked_fill(~windows.mask, 0.0)
    return replace(windows, returns_to_go=returns)
