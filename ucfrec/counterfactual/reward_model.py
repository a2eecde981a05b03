"""Causal reward model: the reward as a function of state, action and a latent disturbance."""

import math
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.arrays import Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Transitions
from ucfrec.settings import (
    BatchSize,
    LearningRate,
    Weight,
    WeightDecay,
    Width,
    require,
    settings_table,
)
from ucfrec.user_model.reward import CLIP, ItemRewardModel
from ucfrec.user_model.reward_report import RewardRows

_LOG_2PI = math.log(2 * math.pi)


@settings_table("crm")
class CRMConfig:
    """Architecture and training of the reward model (paper appendix G.1, Table 4).

    `decoder_std` and `mean_first` are not specified in the paper. With the small β of Table 4, z
    of a plain CVAE encodes the reward itself instead of the disturbance, so every edit seems to
    keep the reward. Learning E[r | s, a] first and abducing z from the residual prevents this: on
    synthetic data whose disturbance makes up 3% of the reward's variance, z accounts for 78%
    without and 5% with `mean_first`.
    """

    latent_dim: Annotated[int, Field(ge=1, le=4096)] = 16
    """Dimensions of the disturbance z: 16 for locomotion and logs, 32 for AntMaze."""
    hidden: Width = 256
    """Width of the two hidden layers of encoder, decoder and regression."""
    beta: Weight = 0.1
    """β, weight of the KL divergence of z from its prior (Eq. 2)."""
    decoder_std: Annotated[float, Field(gt=0, le=1000)] = 0.1
    """Standard deviation of p(r | s, a, z), in those of the reward. A disturbance below
    β × decoder_std² of the reward's variance is not abduced; the default is that of the gate."""
    mean_first: bool = True
    """Fit E[r | s, a] by regression, freeze it, then train the CVAE on top; false: Eq. 2 alone."""
    mean: Literal["network", "effects"] = "network"
    """What E[r | s, a] is: a `network` of state and action; or, where actions are items, additive
    `effects` of item, user, what was shown before and the state."""
    learning_rate: LearningRate = 4e-3
    """Highest learning rate of the CVAE, half of which is the regression's; it falls to 0 along a
    cosine."""
    weight_decay: WeightDecay = 1e-4
    """Weight decay of AdamW."""
    batch_size: BatchSize = 256
    """Transitions per update."""
    epochs: Annotated[int, Field(ge=0, le=100_000)] = 0
    """Maximum number of passes over the transitions, for regression and CVAE each; 0 selects 5, or
    from few transitions as many as take 800 updates. The regression is fitted by a sixth and a
    third of them first, and by all only if more has helped."""
    patience: Annotated[int, Field(ge=0, le=100_000)] = 5
    """Passes without a better validation loss before the CVAE stops early; 0 never stops early."""
    max_transitions: Annotated[int, Field(ge=100, le=10**9)] = 200_000
    """Maximum number of transitions to train on; from more, a random sample is drawn."""

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        require(
            self.mean_first or self.mean == "network",
            f"crm.mean is {self.mean!r}, which needs crm.mean_first=true",
            "crm.mean",
            "crm.mean_first",
        )


class Posterior(NamedTuple):
    """Diagonal Gaussian q(z | s, a, r); both fields (..., latent_dim)."""

    mean: Tensor
    log_variance: Tensor


class EffectsMean(nn.Module):
    """E[r | s, a] of an `ItemRewardModel`, as a differentiable function of states.

    Actions are those of `read_transitions`: the item's vector, then the part of the linear
    predictor that does not depend on the state.
    """

    state_mean: Tensor
    state_std: Tensor
    state: Tensor
    interaction: Tensor
    reward: Tensor

    def __init__(self, model: ItemRewardModel) -> None:
        super().__init__()
        self.binary = bool(model.binary)
        for name in ("state_mean", "state_std", "state", "interaction"):
            self.register_buffer(name, model.get_buffer(name).clone())
        ends = (model.reward_low, model.reward_high - model.reward_low)
        units = ends if self.binary else (model.reward_mean, model.reward_std)
        self.register_buffer("reward", torch.stack(units))

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """Expected rewards (...), in reward units, of states (..., S) and actions (..., D + 1)."""
        x = ((states - self.state_mean) / self.state_std).clamp(-CLIP, CLIP)
        vectors, fixed = actions[..., :-1], actions[..., -1]
        scores = fixed + x @ self.state + ((x @ self.interaction) * vectors).sum(-1)
        start, unit = self.reward
        rewards: Tensor = start + unit * (torch.sigmoid(scores) if self.binary else scores)
        return rewards


class CausalRewardModel(nn.Module):
    """Conditional variational autoencoder of the reward (paper Eq. 2, Algorithm 2).

    Methods take states (..., S), actions (..., A) and rewards (...) in their original units. The
    decoder is E[r | s, a] plus a term that depends on z; the encoder's input is the residual
    r − E[r | s, a]. Without `mean_first`, that mean is 0.
    """

    state_mean: Tensor
    state_std: Tensor
    action_mean: Tensor
    action_std: Tensor
    reward_mean: Tensor
    reward_std: Tensor
    surprise_std: Tensor

    expected: nn.Sequential | EffectsMean

    def __init__(
        self,
        state_size: int,
        action_size: int,
        config: CRMConfig,
        mean: EffectsMean | None = None,
    ) -> None:
        """Args:
        action_size: A, the size of an action vector or of an item's embedding; with `mean`, of
            the actions that it reads.
        mean: E[r | s, a]; None for a network that is yet to be trained.
        """
        super().__init__()
        self.config = config
        input_size = state_size + action_size
        self.expected = mean or mlp(input_size, config.hidden, 2, 1)
        self.encoder = mlp(input_size + 1, config.hidden, 2, 2 * config.latent_dim)
        self.decoder = mlp(input_size + config.latent_dim, config.hidden, 2, 1)
        for name, shape in (("state", (state_size,)), ("action", (action_size,)), ("reward", ())):
            self.register_buffer(f"{name}_mean", torch.zeros(shape))
            self.register_buffer(f"{name}_std", torch.ones(shape))
        self.register_buffer("surprise_std", torch.ones(()))

    @property
    def device(self) -> torch.device:
        """Where the model is, and what it is given has to be."""
        return self.state_mean.device

    def encode(self, states: Tensor, actions: Tensor, rewards: Tensor) -> Posterior:
        """The posterior q_ϕ(z | s, a, r)."""
        return self._encode(self.given(states, actions), self.residual(states, actions, rewards))

    def _encode(self, inputs: Tensor, residual: Tensor) -> Posterior:
        surprise = (residual / self.surprise_std).unsqueeze(-1)
        mean, log_variance = self.encoder(torch.cat([inputs, surprise], dim=-1)).chunk(2, dim=-1)
        return Posterior(mean, log_variance.clamp(-12.0, 6.0))

    def abduct(self, states: Tensor, actions: Tensor, rewards: Tensor) -> Tensor:
        """z = μ_ϕ(s, a, r), the posterior mean (..., latent_dim) of Algorithms 3 to 5."""
        return self.encode(states, actions, rewards).mean

    def predict(self, states: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        """f̂_r(s, a, z), the predicted rewards (...) in reward units."""
        disturbance = self._disturbance(self.given(states, actions), z)
        decoded = self.expected_reward(states, actions) + disturbance
        return self.reward_mean + self.reward_std * decoded

    def elbo(self, inputs: Tensor, residual: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Log likelihood and KL of Eq. 2, each (...) in nats, at z = μ + σ·noise, with standard
        normal noise (..., latent_dim). Inputs are what `given`, residuals what `residual` gives."""
        q = self._encode(inputs, residual)
        z = q.mean + (0.5 * q.log_variance).exp() * noise
        error = self._disturbance(inputs, z) - residual
        scale = self.config.decoder_std
        log_likelihood = -0.5 * ((error / scale).square() + _LOG_2PI) - math.log(scale)
        return log_likelihood, kl_to_prior(q).sum(-1)

    def residual(self, states: Tensor, actions: Tensor, rewards: Tensor) -> Tensor:
        """The residual r − E[r | s, a], in standard deviations of the reward, (...)."""
        return self.normalised_rewards(rewards) - self.expected_reward(states, actions)

    def _disturbance(self, inputs: Tensor, z: Tensor) -> Tensor:
        """What z adds to the expected reward, in standard deviations of the reward, (...)."""
        disturbance: Tensor = self.decoder(torch.cat([inputs, z], dim=-1)).squeeze(-1)
        if isinstance(self.expected, EffectsMean):
            # With z at its prior mean, the model predicts exactly E[r | s, a].
            without = torch.cat([inputs, torch.zeros_like(z)], dim=-1)
            disturbance = disturbance - self.decoder(without).squeeze(-1)
        return disturbance

    def expected_reward(self, states: Tensor, actions: Tensor) -> Tensor:
        """E[r | s, a], standardised as rewards are, (...); 0 without `mean_first`."""
        if not self.config.mean_first:
            return states.new_zeros(states.shape[:-1])
        if isinstance(self.expected, EffectsMean):
            return self.normalised_rewards(self.expected(states, actions))
        expected: Tensor = self.expected(self.given(states, actions)).squeeze(-1)
        return expected

    def given(self, states: Tensor, actions: Tensor) -> Tensor:
        """Normalised states and actions, concatenated, (..., S + A)."""
        actions = _normalise(actions, self.action_mean, self.action_std)
        return torch.cat([self.normalised_states(states), actions], dim=-1)

    def normalised_states(self, states: Tensor) -> Tensor:
        """States (..., S), standardised; 0 in dimensions that never vary in training."""
        return _normalise(states, self.state_mean, self.state_std)

    def moves(self, states: Tensor, edited: Tensor) -> Tensor:
        """Δ = (s_c − s) / σ_s of Eq. 3, (..., S); infinite where s never varies but s_c differs."""
        difference = edited - states
        return torch.where(difference == 0, 0.0, difference / self.state_std)

    def normalised_rewards(self, rewards: Tensor) -> Tensor:
        """Rewards (...), standardised."""
        return _normalise(rewards, self.reward_mean, self.reward_std)


def kl_to_prior(q: Posterior) -> Tensor:
    """KL(q ‖ N(0, I)) of each dimension, (..., latent_dim) in nats."""
    return 0.5 * (q.mean.square() + q.log_variance.exp() - 1 - q.log_variance)


def mlp(inputs: int, hidden: int, layers: int, outputs: int) -> nn.Sequential:
    """A network of `layers` hidden layers of width `hidden` with ReLU, and a linear output."""
    blocks: list[nn.Module] = []
    for layer in range(layers):
        blocks += [nn.Linear(hidden if layer else inputs, hidden), nn.ReLU()]
    return nn.Sequential(*blocks, nn.Linear(hidden, outputs))


def _normalise(values: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    return (values - mean) / torch.where(std > 0, std, 1.0)


@torch.no_grad()
def read_transitions(
    view: EpisodeStore,
    episodes: IntArray,
    steps: IntArray,
    item_rewards: ItemRewardModel | None = None,
    actions: Array | None = None,
) -> Transitions:
    """Single steps of a view with the actions (M, A) that the reward model is fitted to.

    Args:
        item_rewards: what `EffectsMean` is made of; actions are then (M, D + 1): the vectors of
            the items, then what of their scores does not depend on the state.
        actions: (M,) items or (M, A) vectors instead of the logged actions; None for these.
    """
    transitions = view.transitions(episodes, steps)
    other = None if actions is None else torch.from_numpy(actions)
    if item_rewards is None:
        if other is None:
            return transitions
        return replace(transitions, actions=view.action_vectors(other))
    rows = RewardRows.at(view, episodes, steps, item_rewards.reach)
    items = rows.items if other is None else other
    fixed = item_rewards.score_without_state(rows.history, rows.users, items)
    return replace(transitions, actions=torch.cat([item_rewards.vectors[items], fixed[:, None]], 1))
