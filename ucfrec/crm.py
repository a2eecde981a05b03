"""Causal reward model: what about a reward its state and action do not explain."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.errors import InputError
from ucfrec.train import Fit, LoopConfig, fit
from ucfrec.windows import Transitions

_ACTIVE_NATS = 0.01
_QUANTILES = (0.5, 0.9, 0.95, 0.99)
_CONSTANT = 1e-6
_VALIDATION_LIMIT = 20_000


@dataclass(frozen=True)
class CRMConfig:
    """How the reward model is built and trained (paper appendix G.1, Table 4)."""

    latent_dim: int = 16
    """16 for locomotion and logs, 32 for AntMaze."""
    hidden: int = 256
    beta: float = 0.1
    decoder_std: float = 0.1
    """Standard deviation of p(r | s, a, z), in standard deviations of the reward.

    The paper leaves it open. Together with β it sets the smallest disturbance that is abduced: one
    whose share of the reward's variance is β × decoder_std². The default is the tolerance of the
    acceptance gate, so that what the gate could notice is abduced.
    """
    learning_rate: float = 3e-4
    weight_decay: float = 1e-4
    batch_size: int = 256
    epochs: int = 40
    patience: int = 5
    """Epochs without a better held-out ELBO before stopping early."""
    max_transitions: int = 200_000
    """Most transitions to train on; of more, that many are drawn."""


@dataclass(frozen=True)
class CRMReport:
    """How far the reward model can be believed, measured on held-out steps."""

    train_transitions: int
    validation_transitions: int
    steps: int
    reward_std: float
    """Of the training rewards."""
    r2: float
    """Share of the reward's variance predicted with the abduced z (which has seen the reward)."""
    r2_without_z: float
    """The same with z at its prior mean: what state and action alone predict."""
    z_share: float
    """Share of the reward's variance that z accounts for (Sobol's total effect of z on f̂_r)."""
    latent_dim: int
    active_dimensions: int
    """Latent dimensions with a mean KL above 0.01 nats."""
    kl: tuple[float, ...]
    """(latent_dim,) mean KL(q(z_i | s, a, r) ‖ p(z_i)) in nats, largest first."""
    delta: Mapping[str, float]
    """Quantiles of |f̂_r(s, a, z) − r| in reward units: Proposition 1's δ at factual states."""
    warning: str
    """In plain words, what is wrong with abduction; empty if nothing is."""


class Posterior(NamedTuple):
    """Diagonal Gaussian q(z | s, a, r)."""

    mean: Tensor
    """(..., latent_dim)."""
    log_variance: Tensor
    """(..., latent_dim)."""


class CausalRewardModel(nn.Module):
    """Conditional variational autoencoder of the reward (paper Eq. 2, Algorithm 2).

    Takes and gives states, actions and rewards in their own units; normalisation is inside.
    """

    state_mean: Tensor
    state_std: Tensor
    action_mean: Tensor
    action_std: Tensor
    reward_mean: Tensor
    reward_std: Tensor

    def __init__(self, state_size: int, action_size: int, config: CRMConfig) -> None:
        super().__init__()
        self.config = config
        given = state_size + action_size
        self.encoder = mlp(given + 1, config.hidden, 2, 2 * config.latent_dim)
        self.decoder = mlp(given + config.latent_dim, config.hidden, 2, 1)
        for name, shape in (("state", (state_size,)), ("action", (action_size,)), ("reward", ())):
            self.register_buffer(f"{name}_mean", torch.zeros(shape))
            self.register_buffer(f"{name}_std", torch.ones(shape))

    def set_statistics(self, states: Tensor, actions: Tensor, rewards: Tensor) -> None:
        """Take mean and standard deviation from training data; constants get deviation 0."""
        for name, values in (("state", states), ("action", actions), ("reward", rewards)):
            mean, std = _statistics(values)
            getattr(self, f"{name}_mean").copy_(mean)
            getattr(self, f"{name}_std").copy_(std)

    def encode(self, states: Tensor, actions: Tensor, rewards: Tensor) -> Posterior:
        """q_ϕ(z | s, a, r) for states (..., S), actions (..., A), rewards (...)."""
        reward = _normalise(rewards, self.reward_mean, self.reward_std).unsqueeze(-1)
        features = torch.cat([self._given(states, actions), reward], dim=-1)
        mean, log_variance = self.encoder(features).chunk(2, dim=-1)
        return Posterior(mean, log_variance.clamp(-12.0, 6.0))

    def abduct(self, states: Tensor, actions: Tensor, rewards: Tensor) -> Tensor:
        """z = μ_ϕ(s, a, r), the posterior mean (..., latent_dim) of Algorithms 3 to 5."""
        return self.encode(states, actions, rewards).mean

    def predict(self, states: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        """f̂_r(s, a, z), the predicted rewards (...) in reward units."""
        return self.reward_mean + self.reward_std * self._decode(states, actions, z)

    def elbo(self, states: Tensor, actions: Tensor, rewards: Tensor, noise: Tensor) -> "ELBO":
        """Both terms of Eq. 2, each (...), with z = μ + σ·noise and noise (..., latent_dim)."""
        q = self.encode(states, actions, rewards)
        z = q.mean + (0.5 * q.log_variance).exp() * noise
        target = _normalise(rewards, self.reward_mean, self.reward_std)
        error = (self._decode(states, actions, z) - target) / self.config.decoder_std
        log_likelihood = -0.5 * (error.square() + _LOG_2PI) - math.log(self.config.decoder_std)
        return ELBO(log_likelihood, kl_to_prior(q).sum(-1), self.config.beta)

    def _decode(self, states: Tensor, actions: Tensor, z: Tensor) -> Tensor:
        features = torch.cat([self._given(states, actions), z], dim=-1)
        return self.decoder(features).squeeze(-1)  # type: ignore[no-any-return]

    def _given(self, states: Tensor, actions: Tensor) -> Tensor:
        return torch.cat(
            [
                _normalise(states, self.state_mean, self.state_std),
                _normalise(actions, self.action_mean, self.action_std),
            ],
            dim=-1,
        )


_LOG_2PI = math.log(2 * math.pi)


@dataclass(frozen=True)
class ELBO:
    """The two terms of Eq. 2 and their weight."""

    log_likelihood: Tensor
    kl: Tensor
    beta: float

    @property
    def value(self) -> Tensor:
        """log p(r | s, a, z) − β KL(q(z | s, a, r) ‖ p(z)), averaged."""
        return (self.log_likelihood - self.beta * self.kl).mean()


def kl_to_prior(q: Posterior) -> Tensor:
    """KL(q ‖ N(0, I)) of each dimension, (..., latent_dim) in nats."""
    return 0.5 * (q.mean.square() + q.log_variance.exp() - 1 - q.log_variance)


def mlp(inputs: int, hidden: int, layers: int, outputs: int) -> nn.Sequential:
    """`layers` hidden layers with ReLU, then a linear one."""
    sizes = [inputs] + [hidden] * layers
    blocks = [
        module
        for before, after in zip(sizes, sizes[1:], strict=False)
        for module in (nn.Linear(before, after), nn.ReLU())
    ]
    return nn.Sequential(*blocks, nn.Linear(hidden, outputs))


def fit_crm(
    train: Transitions, validation: Transitions, config: CRMConfig, folder: Path, seed: int
) -> tuple[CausalRewardModel, CRMReport]:
    """Train the reward model (Algorithm 2), stopping early on the held-out ELBO.

    Args:
        train: transitions of the training window.
        validation: held-out transitions, never trained on.
        folder: where the training loop keeps its checkpoint; resumed from if there is one.

    Returns:
        The model with the best held-out ELBO, in evaluation mode, and what it is worth.

    Raises:
        InputError: all training rewards are equal, or nothing is held out.
    """
    rng = np.random.default_rng(seed)
    train = _at_most(train, config.max_transitions, rng)
    held_out = _at_most(validation, _VALIDATION_LIMIT, rng)
    _require_signal(train, held_out)

    torch.manual_seed(seed)
    model = CausalRewardModel(train.states.shape[1], train.actions.shape[1], config)
    model.set_statistics(train.states, train.actions, train.rewards)
    fixed_noise = torch.from_numpy(_standard_normal(rng, len(held_out.rewards), config.latent_dim))

    def draw(generator: np.random.Generator) -> tuple[Tensor, ...]:
        rows = torch.from_numpy(generator.integers(len(train.rewards), size=config.batch_size))
        noise = torch.from_numpy(_standard_normal(generator, config.batch_size, config.latent_dim))
        return train.states[rows], train.actions[rows], train.rewards[rows], noise

    def loss(batch: tuple[Tensor, ...]) -> tuple[Tensor, Mapping[str, Tensor]]:
        elbo = model.elbo(*batch)
        parts = {"log_likelihood": elbo.log_likelihood.mean(), "kl": elbo.kl.mean()}
        return -elbo.value, parts

    def held_out_loss() -> float:
        elbo = model.elbo(held_out.states, held_out.actions, held_out.rewards, fixed_noise)
        return -float(elbo.value)

    epoch = max(1, len(train.rewards) // config.batch_size)
    loop = LoopConfig(
        steps=config.epochs * epoch,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        warmup_steps=0,
        clip_norm=0.0,
        validate_every=epoch,
        patience=config.patience,
    )
    fitted = fit(
        model, draw, loss, loop, folder, seed=seed, validate=held_out_loss, describe="reward model"
    )
    return model, _report(model, fitted, len(train.rewards), held_out)


@torch.no_grad()
def _report(
    model: CausalRewardModel, fitted: Fit, n_train: int, held_out: Transitions
) -> CRMReport:
    s, a, r = held_out.states, held_out.actions, held_out.rewards
    q = model.encode(s, a, r)
    with_z = model.predict(s, a, q.mean)
    without_z = model.predict(s, a, torch.zeros_like(q.mean))
    # Rows are in random order, so a neighbour's z is a draw from its marginal (Jansen 1999).
    other_z = model.predict(s, a, q.mean.roll(1, dims=0))
    variance = float(r.var(correction=0)) or math.nan
    kl = kl_to_prior(q).mean(dim=0).sort(descending=True).values
    errors = (with_z - r).abs().double()
    report = CRMReport(
        train_transitions=n_train,
        validation_transitions=len(r),
        steps=fitted.steps,
        reward_std=float(model.reward_std),
        r2=1 - float((with_z - r).square().mean()) / variance,
        r2_without_z=1 - float((without_z - r).square().mean()) / variance,
        z_share=0.5 * float((with_z - other_z).square().mean()) / variance,
        latent_dim=kl.numel(),
        active_dimensions=int((kl > _ACTIVE_NATS).sum()),
        kl=tuple(kl.tolist()),
        delta={f"{q:g}": float(errors.quantile(q)) for q in _QUANTILES},
        warning="",
    )
    return replace(report, warning=_warning(report))


def _warning(report: CRMReport) -> str:
    if report.active_dimensions == 0:
        return (
            "latent collapse: the reward model uses none of its "
            f"{report.latent_dim} latent dimensions, so nothing is abduced; state and action alone "
            f"predict {report.r2_without_z:.1%} of the reward's variance"
        )
    if report.z_share < 0.01:
        return (
            f"near collapse: z accounts for {report.z_share:.2%} of the reward's variance; what is "
            "abduced hardly matters"
        )
    return ""


def _require_signal(train: Transitions, held_out: Transitions) -> None:
    if len(train.rewards) == 0 or len(held_out.rewards) == 0:
        empty = "training" if len(train.rewards) == 0 else "held-out"
        raise InputError(f"the reward model has no {empty} transitions; check the store's split")
    if float(_statistics(train.rewards)[1]) == 0:
        raise InputError(
            f"all {len(train.rewards)} training rewards equal {float(train.rewards[0]):g}: there is "
            "nothing to model; check the reward expression"
        )


def _at_most(transitions: Transitions, limit: int, rng: np.random.Generator) -> Transitions:
    rows = torch.from_numpy(rng.permutation(len(transitions.rewards))[:limit])
    return Transitions(**{name: values[rows] for name, values in vars(transitions).items()})


def _standard_normal(generator: np.random.Generator, *shape: int) -> np.ndarray:
    return generator.standard_normal(shape, dtype=np.float32)


def _statistics(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation over rows, in float64; a deviation within rounding of 0 is 0."""
    values = values.double()
    mean, std = values.mean(dim=0), values.std(dim=0, correction=0)
    return mean, torch.where(std > _CONSTANT * mean.abs().clamp(min=1.0), std, 0.0)


def _normalise(values: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    return (values - mean) / torch.where(std > 0, std, 1.0)
