"""Causal reward model: the reward as a function of state, action and a latent disturbance, fitted
by Algorithm 2, with its quality on held-out steps."""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.arrays import Float32Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Transitions
from ucfrec.errors import InputError
from ucfrec.files.record import Undefinable
from ucfrec.fitting.checkpoint import load_weights
from ucfrec.fitting.loop import Fit, LoopConfig, fit, load_trained
from ucfrec.processes import random_state_kept
from ucfrec.settings import BatchSize, LearningRate, Weight, WeightDecay, Width, settings_table

_LOG_2PI = math.log(2 * math.pi)
INITIAL = "initial.safetensors"
"""Weights of an older reward model, in the folder of the new one."""
_ACTIVE_NATS, _LEAK = 0.01, 0.1
_PREDICTS_NOTHING = 0.02
"""R² on held-out steps at or below which a reward model counts as useless."""
_QUANTILES = (0.5, 0.9, 0.95, 0.99)
_CONSTANT = 1e-6
_EPOCHS, _LEAST_UPDATES = 5, 800
"""Passes, or from few transitions updates, where the setting leaves the choice."""
_MOST_VALIDATIONS = 20
_REGRESSION_RATE = 0.5
"""Learning rate of the regression, in that of the CVAE."""
_REGRESSION_SHARES = (6, 3, 1)
"""The regression is fitted by this part of the updates, one after the other, while that helps."""
_VALIDATION_LIMIT = 20_000
_CHUNK, _AT_ONCE = 16_384, 1024
_CPU = torch.device("cpu")
_Rows = tuple[Tensor, ...]


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


class Posterior(NamedTuple):
    """Diagonal Gaussian q(z | s, a, r); both fields (..., latent_dim)."""

    mean: Tensor
    log_variance: Tensor

    @property
    def kl(self) -> Tensor:
        """KL(q ‖ N(0, I)) of each dimension, (..., latent_dim) in nats."""
        return 0.5 * (self.mean.square() + self.log_variance.exp() - 1 - self.log_variance)


class CausalRewardModel(nn.Module):
    """Conditional variational autoencoder of the reward (paper Eq. 2, Algorithm 2), of states
    (..., S), actions (..., A) and rewards (...) in original units. The decoder is E[r | s, a], or
    without `mean_first` 0, plus a term of z; the encoder's input is r − E[r | s, a]."""

    def __init__(self, state_size: int, action_size: int, config: CRMConfig) -> None:
        super().__init__()
        self.config = config
        input_size = state_size + action_size
        self.expected = mlp(input_size, config.hidden, 2, 1)
        self.encoder = mlp(input_size + 1, config.hidden, 2, 2 * config.latent_dim)
        self.decoder = mlp(input_size + config.latent_dim, config.hidden, 2, 1)
        self.state_mean = nn.Buffer(torch.zeros(state_size))
        self.state_std = nn.Buffer(torch.ones(state_size))
        self.action_mean = nn.Buffer(torch.zeros(action_size))
        self.action_std = nn.Buffer(torch.ones(action_size))
        self.reward_mean = nn.Buffer(torch.zeros(()))
        self.reward_std = nn.Buffer(torch.ones(()))
        self.surprise_std = nn.Buffer(torch.ones(()))

    @property
    def device(self) -> torch.device:
        """The device of the model, where its inputs have to be."""
        return self.state_mean.device

    def encode(self, inputs: Tensor, residual: Tensor) -> Posterior:
        """The posterior q_ϕ(z | s, a, r), of what `given` and `residual` return."""
        surprise = (residual / self.surprise_std).unsqueeze(-1)
        encoded = self.encoder(torch.cat([inputs, surprise], dim=-1))
        mean, log_variance = encoded.chunk(2, dim=-1)
        return Posterior(mean, log_variance.clamp(-12.0, 6.0))

    def abduct(
        self,
        states: Tensor,
        actions: Tensor,
        rewards: Tensor,
    ) -> Tensor:
        """z = μ_ϕ(s, a, r), the posterior mean (..., latent_dim) of Algorithms 3 to 5."""
        residual = self.residual(states, actions, rewards)
        return self.encode(self.given(states, actions), residual).mean

    def predict(
        self,
        states: Tensor,
        actions: Tensor,
        z: Tensor,
    ) -> Tensor:
        """f̂_r(s, a, z), the predicted rewards (...) in reward units."""
        disturbance = self._disturbance(self.given(states, actions), z)
        decoded = self.predict_expected(states, actions) + disturbance
        return self.reward_mean + self.reward_std * decoded

    def elbo(
        self,
        inputs: Tensor,
        residual: Tensor,
        noise: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Log likelihood and KL of Eq. 2, each (...) in nats, at z = μ + σ·noise, with standard
        normal noise (..., latent_dim), of what `given` and `residual` return."""
        q = self.encode(inputs, residual)
        z = q.mean + (0.5 * q.log_variance).exp() * noise
        error = self._disturbance(inputs, z) - residual
        scale = self.config.decoder_std
        log_likelihood = -0.5 * ((error / scale).square() + _LOG_2PI) - math.log(scale)
        return log_likelihood, q.kl.sum(-1)

    def residual(
        self,
        states: Tensor,
        actions: Tensor,
        rewards: Tensor,
    ) -> Tensor:
        """The residual r − E[r | s, a], in standard deviations of the reward, (...)."""
        return self.normalise_rewards(rewards) - self.predict_expected(states, actions)

    def _disturbance(self, inputs: Tensor, z: Tensor) -> Tensor:
        """What z adds to the expected reward, in its standard deviations, (...)."""
        disturbance: Tensor = self.decoder(torch.cat([inputs, z], dim=-1)).squeeze(-1)
        return disturbance

    def predict_expected(self, states: Tensor, actions: Tensor) -> Tensor:
        """E[r | s, a], standardised as rewards are, (...); 0 without `mean_first`."""
        if not self.config.mean_first:
            return states.new_zeros(states.shape[:-1])
        expected: Tensor = self.expected(self.given(states, actions)).squeeze(-1)
        return expected

    def given(self, states: Tensor, actions: Tensor) -> Tensor:
        """Normalised states and actions, concatenated, (..., S + A)."""
        actions = _normalise(actions, self.action_mean, self.action_std)
        return torch.cat([self.normalise_states(states), actions], dim=-1)

    def normalise_states(self, states: Tensor) -> Tensor:
        """States (..., S), standardised; 0 in dimensions that never vary in training."""
        return _normalise(states, self.state_mean, self.state_std)

    def moves(self, states: Tensor, edited: Tensor) -> Tensor:
        """Δ = (s_c − s) / σ_s of Eq. 3, (..., S); infinite where s never varies but s_c differs."""
        difference = edited - states
        return torch.where(difference == 0, 0.0, difference / self.state_std)

    def normalise_rewards(self, rewards: Tensor) -> Tensor:
        """Rewards (...), standardised."""
        return _normalise(rewards, self.reward_mean, self.reward_std)


def mlp(
    inputs: int,
    hidden: int,
    layers: int,
    outputs: int,
) -> nn.Sequential:
    """A network of `layers` hidden layers of width `hidden` with ReLU, and a linear output."""
    blocks: list[nn.Module] = []
    for layer in range(layers):
        blocks += [nn.Linear(hidden if layer else inputs, hidden), nn.ReLU()]
    return nn.Sequential(*blocks, nn.Linear(hidden, outputs))


def _normalise(values: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    return (values - mean) / torch.where(std > 0, std, 1.0)


@dataclass(frozen=True)
class CRMReport:
    """Quality of the reward model, measured on held-out steps."""

    train_transitions: int
    validation_transitions: int
    reward_std: float
    """Of the training rewards, in reward units."""
    r2: Undefinable
    """R² of f̂_r(s, a, z) with the abduced z, which is computed from the reward itself."""
    r2_without_z: Undefinable
    """R² of f̂_r(s, a, 0), with z at its prior mean: what state and action alone predict."""
    z_share: float
    """Share of the reward's variance due to z (Sobol's total effect of z on f̂_r)."""
    z_leak: float
    """Largest |correlation| of an active z_i with f̂_r(s, a, 0); 0 for a true disturbance."""
    latent_dim: int
    active_dimensions: int
    """Number of latent dimensions with a mean KL above 0.01 nats."""
    kl: tuple[float, ...]
    """(latent_dim,) mean KL(q(z_i | s, a, r) ‖ p(z_i)) in nats."""
    delta: Mapping[str, float]
    """Quantiles of |f̂_r(s, a, z) − r| in reward units: Proposition 1's δ at factual states."""
    warning: str = ""
    """A warning about the abduction of z; empty if there is no problem."""


@random_state_kept()
def fit_crm(
    train: Transitions,
    validation: Transitions,
    config: CRMConfig,
    folder: Path,
    seed: int,
    device: torch.device = _CPU,
) -> tuple[CausalRewardModel, CRMReport]:
    """Train the reward model (Algorithm 2) with early stopping on held-out steps; the model with
    the lowest validation loss, in evaluation mode, and its quality.

    Args:
        folder: of the checkpoints, which training resumes from, and perhaps of `INITIAL`.
        device: where the model is fitted, and stays. What is drawn is the same on all.
    """
    rng = np.random.default_rng(seed)
    train, held_out = (
        steps.at(rng.permutation(len(steps.rewards))[:limit]).to(device)
        for steps, limit in ((train, config.max_transitions), (validation, _VALIDATION_LIMIT))
    )
    torch.manual_seed(seed)
    model = CausalRewardModel(train.states.shape[1], train.actions.shape[1], config)
    model = model.to(device)
    for name in ("state", "action", "reward"):
        values = getattr(train, f"{name}s").double()
        average, std = values.mean(dim=0), values.std(dim=0, correction=0)
        # Rounding errors become 0.
        std = torch.where(std > _CONSTANT * average.abs().clamp(min=_CONSTANT), std, 0.0)
        model.get_buffer(f"{name}_mean").copy_(average)
        model.get_buffer(f"{name}_std").copy_(std)
    if not model.reward_std:
        raise InputError(
            f"the rewards of the {len(train.rewards):,} steps that the reward model learns from "
            "are equal, or nearly so; raise crm.max_transitions, or set augment.copies=0"
        )
    if (folder / INITIAL).exists():
        load_weights(folder / INITIAL, model, load_trained(folder / INITIAL))
    if config.mean_first:
        _fit_mean(model, train, held_out, folder / "mean", seed)
    rows, (inputs, residual) = (_read_inputs(model, steps) for steps in (train, held_out))
    if config.mean_first:
        model.expected.requires_grad_(False)
        variance = float(rows[1].double().square().mean())
        model.surprise_std.fill_(max(variance, 1e-8) ** 0.5)

    def loss(batch: _Rows) -> tuple[Tensor, Mapping[str, Tensor]]:
        inputs, residual, noise = batch
        log_likelihood, kl = (term.mean() for term in model.elbo(inputs, residual, noise))
        parts = {"log_likelihood": log_likelihood.detach(), "kl": kl.detach()}
        return config.beta * kl - log_likelihood, parts

    noise = _draw_noise(np.random.default_rng(seed), residual, config.latent_dim)
    loop = _loop(config, len(train.rewards))
    _fit(
        model, loss, rows, (inputs, residual, noise), loop, folder / "cvae", seed, config.latent_dim
    )
    return model, _report(model, len(train.rewards), held_out)


def _fit_mean(
    model: CausalRewardModel,
    train: Transitions,
    held_out: Transitions,
    folder: Path,
    seed: int,
) -> None:
    rows, held_out_rows = (
        (model.given(steps.states, steps.actions), model.normalise_rewards(steps.rewards))
        for steps in (train, held_out)
    )

    def loss(batch: _Rows) -> tuple[Tensor, Mapping[str, Tensor]]:
        expected = model.expected(batch[0]).squeeze(-1)
        return (batch[1] - expected).square().mean(), {}

    first = copy.deepcopy(model.expected.state_dict())
    whole = _loop(model.config, len(rows[1]))
    best, weights = math.inf, first
    for share in _REGRESSION_SHARES:
        steps = max(1, whole.steps // share)
        loop = replace(
            whole,
            steps=steps,
            learning_rate=_REGRESSION_RATE * whole.learning_rate,
            warmup_steps=steps // 20,
            validate_every=max(1, steps // 3),
        )
        model.expected.load_state_dict(first)
        outcome = _fit(model.expected, loss, rows, held_out_rows, loop, folder / str(steps), seed)
        if outcome.best_validation >= best:
            break
        best, weights = outcome.best_validation, copy.deepcopy(model.expected.state_dict())
    model.expected.load_state_dict(weights)


@torch.no_grad()
def _read_inputs(model: CausalRewardModel, transitions: Transitions) -> _Rows:
    """What the CVAE sees of the steps: normalised inputs (M, S + A) and residuals (M,)."""
    s, a, r = transitions.states, transitions.actions, transitions.rewards
    parts = [slice(start, start + _CHUNK) for start in range(0, len(r), _CHUNK)]
    inputs = torch.cat([model.given(s[part], a[part]) for part in parts])
    return inputs, torch.cat([model.residual(s[part], a[part], r[part]) for part in parts])


def _fit(
    module: nn.Module,
    loss: Callable[[_Rows], tuple[Tensor, Mapping[str, Tensor]]],
    rows: _Rows,
    held_out: _Rows,
    loop: LoopConfig,
    folder: Path,
    seed: int,
    noise: int = 0,
) -> Fit:
    """Fit a part of the model to batches of inputs and targets, with `noise` numbers a row."""
    inputs, target = rows

    def draw(generator: np.random.Generator) -> _Rows:
        numbers = generator.integers(len(target), size=loop.batch_size)
        at = torch.from_numpy(numbers).to(target.device)
        return inputs[at], target[at], _draw_noise(generator, target[at], noise)

    def validate() -> float:
        # Of few rows at once: what a layer returns then stays in the cache.
        total = 0.0
        for start in range(0, len(held_out[0]), _AT_ONCE):
            part = tuple(values[start : start + _AT_ONCE] for values in held_out)
            total += float(loss(part)[0]) * len(part[0])
        return total / len(held_out[0])

    what = "reward model" if noise else "expected reward"
    return fit(module, draw, loss, loop, folder, seed=seed, validate=validate, describe=what)


def _loop(config: CRMConfig, transitions: int) -> LoopConfig:
    epoch = max(1, transitions // config.batch_size)
    steps = epoch * (config.epochs or max(_EPOCHS, math.ceil(_LEAST_UPDATES / epoch)))
    return LoopConfig(
        steps=steps,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=config.weight_decay,
        warmup_steps=steps // 20,
        cosine=True,
        clip_norm=0.0,
        validate_every=max(epoch, steps // _MOST_VALIDATIONS),
        patience=config.patience,
        average=0.0,
    )


def _draw_noise(generator: np.random.Generator, target: Tensor, size: int) -> Tensor:
    values: Float32Array = generator.standard_normal((len(target), size), dtype=np.float32)
    return torch.from_numpy(values).to(target.device)


@torch.no_grad()
def _report(model: CausalRewardModel, n_train: int, held_out: Transitions) -> CRMReport:
    s, a, r = held_out.states, held_out.actions, held_out.rewards
    q = model.encode(model.given(s, a), model.residual(s, a, r))
    with_z = model.predict(s, a, q.mean)
    without_z = model.predict(s, a, torch.zeros_like(q.mean))
    # Rows are in random order, so the z of the next row is a draw from the marginal distribution,
    # as Jansen's estimator of the total effect needs.
    other_z = model.predict(s, a, q.mean.roll(1, dims=0))
    variance = float(r.var(correction=0)) or math.nan
    kl = q.kl.mean(dim=0)
    active = kl > _ACTIVE_NATS
    columns = torch.cat([without_z.unsqueeze(1), q.mean[:, active]], dim=1)
    correlations = torch.corrcoef(columns.T).nan_to_num().abs()
    leak = correlations.reshape(columns.shape[1], -1)[0, 1:]
    errors = (with_z - r).abs().double()
    report = CRMReport(
        train_transitions=n_train,
        validation_transitions=len(r),
        reward_std=float(model.reward_std),
        r2=1 - float((with_z - r).square().mean()) / variance,
        r2_without_z=1 - float((without_z - r).square().mean()) / variance,
        z_share=0.5 * float((with_z - other_z).square().mean()) / variance,
        z_leak=float(leak.max()) if len(leak) else 0.0,
        latent_dim=kl.numel(),
        active_dimensions=int(active.sum()),
        kl=tuple(kl.tolist()),
        delta={f"{level:g}": float(errors.quantile(level)) for level in _QUANTILES},
    )
    return replace(report, warning=_warning(report))


def fit_warning(r2_without_z: float) -> str:
    """A warning if the reward model predicts nothing, i.e. its `CRMReport.r2_without_z` is at most
    0.02 or NaN; otherwise empty."""
    if r2_without_z > _PREDICTS_NOTHING:
        return ""
    return (
        f"the reward model predicts nothing: from state and action its R² on held-out steps is "
        f"{r2_without_z:.2f} (0 is what the mean reward alone reaches), so an edit that keeps its "
        "prediction may still change the true reward"
    )


def _warning(report: CRMReport) -> str:
    alone = f"state and action alone predict {report.r2_without_z:.1%} of the reward's variance"
    if report.active_dimensions == 0 or report.z_share < 0.01:
        share = f"z accounts for {report.z_share:.2%} of the reward's variance"
        return f"latent collapse: {share}, so abduction hardly matters; {alone}"
    if report.z_leak > max(_LEAK, 4 / report.validation_transitions**0.5):
        return (
            f"latent leak: z correlates by {report.z_leak:.2f} with what state and action predict, "
            "so it is not a disturbance, and edits that change the reward may pass the gate"
        )
    return ""


def sample_steps(view: EpisodeStore, limit: int, seed: int) -> tuple[IntArray, IntArray]:
    """(episodes, steps) of a view: all, or `limit` drawn with replacement if there are more."""
    if view.n_steps <= limit:
        return view.all_steps()
    return view.draw_steps(np.random.default_rng(seed), limit)
