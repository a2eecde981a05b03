"""EDT4Rec (Chen et al., 2024): a stochastic head with an entropy bound, CQL-relabelled returns."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import Float32Array, Float64Array, IntArray
from ucfrec.counterfactual.reward_model import mlp
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Exposed, Transitions, Windows
from ucfrec.fitting.loop import LoopConfig, fit
from ucfrec.policies.base import Context, PolicyConfig, Returns, standardise
from ucfrec.policies.dt import DTConfig, DTPolicy
from ucfrec.policies.heads import VectorHead
from ucfrec.processes import random_state_kept
from ucfrec.settings import Count, Weight, require, settings_table

_AT_ONCE = 4096
_LOGGED = 100_000
"""Largest number of logged actions that candidates are drawn from."""
_HIDDEN = 128
"""Width of the two hidden layers of CQL's network."""
_CANDIDATES = 20
"""Actions sampled in place of all actions: half from the logs, half uniformly."""
_BATCH_SIZE = 128
_TARGET_RATE = 0.01
"""Rate at which the target network moves to the network at every update."""


class ConservativeQ(nn.Module):
    """Q(s, a) of states and action vectors (embeddings, for items), and its target network; in
    units of the largest absolute training return, without discount."""

    state_mean: Tensor
    state_std: Tensor
    logged: Tensor
    every: Tensor | None
    low: Tensor
    high: Tensor
    unit: Tensor

    def __init__(self, store: EpisodeStore, weight: float) -> None:
        super().__init__()
        self.weight = weight
        mean, std = store.state_statistics
        count, column = store.n_steps, schema.ITEM if store.has_items else schema.ACTION
        sample = np.linspace(0, count - 1, min(count, _LOGGED)).astype(np.int64)
        episodes, steps = store.locate(sample)
        logged = torch.from_numpy(store.step_values(column, episodes, steps))
        vectors = store.action_vectors(logged.long() if store.has_items else logged)
        every = store.item_states.embeddings if store.has_items else None
        self.register_buffer("state_mean", mean)
        self.register_buffer("state_std", torch.where(std > 0, std, 1.0))
        self.register_buffer("logged", vectors)
        self.register_buffer("every", every)
        self.register_buffer("low", vectors.min(0).values)
        self.register_buffer("high", vectors.max(0).values)
        largest = float(np.abs(store.returns).max())
        self.register_buffer("unit", torch.tensor(largest or 1.0))
        inputs = len(mean) + vectors.shape[1]
        self.network = mlp(inputs, _HIDDEN, 2, 1)
        self.target = mlp(inputs, _HIDDEN, 2, 1)
        self.target.load_state_dict(self.network.state_dict())
        self.target.requires_grad_(False)

    def q(
        self,
        states: Tensor,
        actions: Tensor,
        network: nn.Module | None = None,
    ) -> Tensor:
        """Values (M, C) of actions (M, C, A) in states (M, S), by `network` or the trained one."""
        states = standardise(states, self.state_mean, self.state_std)
        states = states.unsqueeze(1).expand(-1, actions.shape[1], -1)
        inputs = torch.cat([states, actions], dim=-1)
        value: Tensor = (network or self.network)(inputs)
        return value.squeeze(-1)

    def candidates(self, count: int) -> Tensor:
        """Random actions (count, C, A) for `count` states."""
        shape = (count, _CANDIDATES // 2)
        logged = self.logged[torch.randint(len(self.logged), shape)]
        if self.every is not None:
            uniform = self.every[torch.randint(len(self.every), shape)]
        else:
            low, high = self.low, self.high
            uniform = low + (high - low) * torch.rand((*shape, len(low)))
        return torch.cat([logged, uniform], dim=1)

    def state_values(self, states: Tensor, network: nn.Module | None = None) -> Tensor:
        """V̂(s) (M,) of states (M, S): mean of Q under the softmax of Q over candidates."""
        values = self.q(states, self.candidates(len(states)), network)
        return (values.softmax(-1) * values).sum(-1)

    def loss(self, batch: Transitions) -> tuple[Tensor, dict[str, Tensor]]:
        """α (logsumexp_a Q(s, a) − Q(s, a_data)) + ½ TD², and scalars; moves the target network."""
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.network.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, _TARGET_RATE)
            next_values = self.state_values(batch.next_states, self.target)
            target = batch.rewards / self.unit + next_values.masked_fill(batch.last, 0.0)
        value = self.q(batch.states, batch.actions.unsqueeze(1))[:, 0]
        values = self.q(batch.states, self.candidates(len(value)))
        values = torch.cat([values, value.unsqueeze(1)], dim=1)
        soft_maximum = values.logsumexp(-1)
        conservative = (soft_maximum - value).mean()
        error = 0.5 * F.mse_loss(value, target)
        return self.weight * conservative + error, {"td": error.detach()}


@random_state_kept()
def relabel(
    store: EpisodeStore,
    steps: int,
    weight: float,
    folder: Path,
    seed: int,
) -> EpisodeStore:
    """The store, without augmented episodes, with returns-to-go raised by CQL's state values.

    Backwards through each episode, R_{t−1} = r_{t−1} + max(R_t, V̂(s_t)). The folder keeps the Q
    function, trained for `steps` updates with the weight α of the conservative term.
    """
    torch.manual_seed(seed)
    network = ConservativeQ(store, weight)
    loop = LoopConfig(
        steps=steps,
        batch_size=_BATCH_SIZE,
        learning_rate=3e-4,
        clip_norm=1.0,
        warmup_steps=0,
        average=0.0,
    )

    def draw(generator: np.random.Generator) -> Transitions:
        episodes, steps = store.draw_steps(generator, _BATCH_SIZE)
        return store.transitions(episodes, steps)

    fit(network, draw, network.loss, loop, folder, seed=seed, describe="cql")
    torch.manual_seed(seed)
    episodes, numbers = store.all_steps()
    parts = []
    with torch.no_grad():
        for begin in range(0, len(numbers), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            states = store.windows(episodes[part], numbers[part], 1).states[:, 0]
            parts.append((network.state_values(states) * network.unit).double().numpy())
    rewards, values = store.column(schema.REWARD), np.concatenate(parts)
    return store.with_returns_to_go(optimistic_returns(rewards, values, store.lengths))


def optimistic_returns(
    rewards: npt.NDArray[np.floating], values: Float64Array, lengths: IntArray
) -> Float32Array:
    """R_t = r_t + max(R_{t+1}, V_{t+1}) (N,) within each episode, R = V = 0 after its end, from
    rewards (N,) and values (N,) before each step of episodes of some lengths (E,).

    With C_t the sum of rewards before t, R_t + C_t is the maximum of V_k + C_k over k > t (V = 0
    after the last step): a running maximum from the end, computed for all episodes at once.
    """
    ends = np.cumsum(lengths)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    total = np.cumsum(rewards, dtype=np.float64)
    earlier = total - rewards  # C_t plus the rewards of earlier episodes
    first = earlier[ends - lengths][owner]
    next_values = np.append(values[1:], 0.0)
    next_values[ends - 1] = 0.0
    attainable = next_values + (total - first)  # V_{t+1} + C_{t+1}
    from_the_end = pd.Series(attainable[::-1])
    highest = from_the_end.groupby(owner[::-1]).cummax()
    in_order = highest.to_numpy()[::-1]
    return np.asarray(in_order - (earlier - first), dtype=np.float32)


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
        cls,
        train: EpisodeStore,
        config: PolicyConfig,
        folder: Path,
        seed: int,
    ) -> EpisodeStore:
        """The episodes with returns-to-go raised by CQL; as logged if `relabel` is false."""
        assert isinstance(config, EDT4RecConfig)
        train = super().training_view(train, config, folder, seed)
        if not config.relabel:
            return train
        return relabel(train, config.cql_steps, config.cql_weight, folder, seed)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative log-likelihood (nats) plus the entropy constraint's terms for λ and policy."""
        normalized = self.normalize(_consistent(windows))
        features = self.features(normalized)
        imitation, scalars = self.imitation(features, normalized)
        exposed = self.exposed(normalized, windows.decided)
        entropy = self.head.entropy(features[windows.decided], exposed)  # type: ignore[operator]
        multiplier = self.log_multiplier.exp()
        constraint = multiplier * (entropy.detach() - self.least_entropy)
        constraint = constraint - multiplier.detach() * entropy
        scalars |= {"entropy": entropy.detach(), "multiplier": multiplier.detach()}
        return imitation + constraint, scalars


class GaussianHead(VectorHead):
    """A diagonal Gaussian whose mean is the action of `VectorHead`, in units of `scale`."""

    def __init__(self, dim: int, size: int) -> None:
        super().__init__(dim, size)
        self.log_deviation = nn.Linear(dim, size)

    def deviations(self, features: Tensor) -> Tensor:
        """Log standard deviations (..., A) from features (..., d), clamped to [−5, 2]."""
        return self.log_deviation(features).clamp(-5.0, 2.0)  # type: ignore[no-any-return]

    def losses(
        self,
        features: Tensor,
        actions: Tensor,
        exposed: Exposed | None = None,
    ) -> Tensor:
        """Negative log-likelihood (nats) of each of M steps, (M,)."""
        log_deviation = self.deviations(features)
        error = (actions - self.predict(features)) / self.scale / log_deviation.exp()
        nats = 0.5 * error.square() + log_deviation + 0.5 * math.log(2 * math.pi)
        return nats.sum(-1)

    def entropy(self, features: Tensor, exposed: Exposed | None = None) -> Tensor:
        """Mean entropy (nats) over M steps, features (M, d)."""
        nats = self.deviations(features) + 0.5 * math.log(2 * math.pi * math.e)
        return nats.sum(-1).mean()


def _consistent(windows: Windows) -> Windows:
    """The windows with returns-to-go that decrease by each step's reward to the last step's value,
    as in acting; relabelled ones of adjacent steps need not."""
    returns = ReturnToGo().before(windows.returns_to_go[:, -1], windows.rewards)
    return replace(windows, returns_to_go=returns.masked_fill(~windows.mask, 0.0))
