"""Clusters of states, and generators: they propose other states with the same predicted reward."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.counterfactual.reward_model import CausalRewardModel, mlp
from ucfrec.episodes.windows import Transitions
from ucfrec.fitting.loop import LoopConfig, fit
from ucfrec.processes import random_state_kept
from ucfrec.settings import (
    BatchSize,
    LearningRate,
    Quantile,
    Weight,
    Width,
    require,
    settings_table,
)

_TINY = 1e-24
Length = Annotated[float, Field(ge=0, le=1e6)]


@settings_table("csg")
class CSGConfig:
    """Kind and settings of the state generator (paper appendix G.2, Table 5)."""

    kind: Literal["tangent", "faithful", "noise"] = "tangent"
    """`tangent` draws a different edit every time; `faithful` is the paper's network, which learns
    nearly one shift for all states; `noise` is the control: moves that ignore the reward."""
    band: tuple[Length, Length] = (0.2, 0.5)
    """(ρ_low, ρ_high): shortest and longest move, in standard deviations of the states."""
    reward_quantile: Quantile = 0.3
    """Steps with a reward below this quantile are excluded from training: 0.3 uses the top 70%."""
    clusters: Annotated[int, Field(ge=1, le=100_000)] = 32
    """tangent: clusters of states, each with its own covariance."""
    corrections: Annotated[int, Field(ge=0, le=1000)] = 3
    """tangent: Newton steps that return a move to the level set of the predicted reward."""
    hidden: Width = 256
    """faithful: width of the three hidden layers."""
    learning_rate: LearningRate = 5e-4
    """faithful: learning rate."""
    batch_size: BatchSize = 256
    """faithful: transitions per update."""
    epochs: Annotated[int, Field(ge=1, le=100_000)] = 40
    """faithful: number of passes over the transitions."""
    lambda_r: Weight = 1.0
    """faithful: weight of the squared change of the predicted reward, in standard deviations."""
    lambda_band: Weight = 0.1
    """faithful: weight of the squared distance of a move's length from the band."""
    max_transitions: Annotated[int, Field(ge=100, le=10**9)] = 200_000
    """Largest number of transitions to train on; from more, a random sample is drawn."""

    def __post_init__(self) -> None:
        """Check that the band is in order."""
        low, high = self.band
        fault = f"csg.band is [{low:g}, {high:g}]; the first length must not exceed the second"
        require(low <= high, fault, "csg.band")


@dataclass(frozen=True)
class StateClusters:
    """C clusters of normalised states by k-means: centres (C, S), covariances (C, S, S)."""

    centres: Tensor
    covariances: Tensor

    @classmethod
    def of(
        cls,
        states: Tensor,
        most: int,
        seed: int,
    ) -> "StateClusters":
        """At most `most` clusters of normalised states (M, S), on the CPU; of few, fewer."""
        # Imported here because it takes a second and 100 MB, and loading a policy does not need it.
        from sklearn.cluster import MiniBatchKMeans

        size = states.shape[1]
        clusters = max(1, min(most, len(states) // (8 * size)))
        fitted = MiniBatchKMeans(clusters, random_state=seed, n_init=1, batch_size=4096)
        labels = torch.from_numpy(fitted.fit_predict(states.numpy()).astype(np.int64))
        centres = torch.from_numpy(fitted.cluster_centers_).float()
        whole = torch.cov(states.T, correction=0).reshape(size, size)
        covariances = torch.empty(clusters, size, size)
        for cluster in range(clusters):
            deviations = states[labels == cluster] - centres[cluster]
            squares, rows = deviations.T @ deviations, len(deviations)
            # Shrunk towards the covariance of all states, because a cluster may have few.
            covariances[cluster] = (squares + size * whole) / (rows + size)
        return cls(centres, covariances)

    def nearest(self, states: Tensor) -> Tensor:
        """(B,) cluster whose centre is nearest to each of the normalised states (B, S)."""
        return torch.cdist(states, self.centres).argmin(dim=1)


class ActionSupport:
    """The actions that the log took in each cluster of states: what else could have been done."""

    def __init__(self, labels: IntArray, actions: Array) -> None:
        """Of M logged steps: clusters (M,) of their states, and items (M,) or vectors (M, A)."""
        order = np.argsort(labels, kind="stable")
        self._labels, self._actions = labels[order], actions[order]

    def draw(self, labels: IntArray, generator: np.random.Generator) -> tuple[Array, BoolArray]:
        """The action of a random logged step of each of B clusters, (B,) or (B, A); and (B,)
        whether the cluster has a logged step at all, without which the action means nothing."""
        first, end = (np.searchsorted(self._labels, labels, side) for side in ("left", "right"))
        numbers = (generator.random(len(labels)) * (end - first)).astype(np.int64)
        places = np.minimum(first + numbers, len(self._actions) - 1)
        return self._actions[places], end > first


class TangentGenerator:
    """Random moves along the level set of the predicted reward, which are not in the paper.

    A move Δ is drawn from a Gaussian with the covariance Σ of the training states in the cluster
    nearest to s, conditioned on an unchanged reward to first order: ∇f̂_r · Δ = 0. It is scaled to a
    length drawn from the band, and returned to the level set by Newton steps along Σ∇f̂_r.
    """

    def __init__(
        self,
        crm: CausalRewardModel,
        clusters: StateClusters,
        config: CSGConfig,
    ) -> None:
        self._crm, self._config, self.band = crm, config, config.band
        matrices = clusters.covariances
        self._clusters = StateClusters(clusters.centres.to(crm.device), matrices.to(crm.device))
        values, vectors = torch.linalg.eigh(matrices)
        roots = vectors * values.clamp(min=0).sqrt().unsqueeze(-2)
        self._roots = roots.to(crm.device)

    @torch.no_grad()
    def propose(
        self,
        at: Transitions,
        z: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """A state s_c (M, S) for each of M steps with abduced disturbances (M, latent_dim), such
        that f̂_r(s_c, a, z) is close to f̂_r(s, a, z). Draws by a `generator` on the CPU."""
        crm, states = self._crm, at.states
        near = self._clusters.nearest(crm.normalise_states(states))
        noise = torch.randn(states.shape, generator=generator).to(states.device)
        length = _lengths(self.band, states, generator)
        # In order of clusters, so that no step needs a copy of its cluster's matrix.
        order = near.argsort(stable=True)
        rows = torch.bincount(near, minlength=len(self._clusters.centres)).tolist()
        s, a, z, length = states[order], at.actions[order], z[order], length[order]

        def predict(move: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            """f̂_r(s + σ_s Δ, a, z) (M,), its gradient in Δ (M, S), and Σ times the gradient."""
            with torch.enable_grad():
                move = move.detach().requires_grad_()
                reward = crm.predict(s + crm.state_std * move, a, z)
                (gradient,) = torch.autograd.grad(reward.sum(), move)
            return reward.detach(), gradient, _products(self._clusters.covariances, gradient, rows)

        reward, gradient, steepest = predict(torch.zeros_like(s))
        move = _products(self._roots, noise[order], rows)
        move = move - steepest * _ratio((gradient * move).sum(1), gradient, steepest)
        move = _scale(move, length, math.inf)
        for _ in range(self._config.corrections):
            current, gradient, steepest = predict(move)
            step = steepest * _ratio(current - reward, gradient, steepest)
            move = _scale(move - _scale(step, length), length)
        return states + crm.state_std * torch.empty_like(move).index_copy_(0, order, move)


class CounterfactualStateGenerator(nn.Module):
    """The paper's generator g_ψ(s, a, z) (Eq. 3, Algorithm 3): a deterministic network."""

    def __init__(self, crm: CausalRewardModel, config: CSGConfig) -> None:
        super().__init__()
        # In a tuple, so that torch does not register the reward model as a submodule.
        self._crm = (crm,)
        self.band = config.band
        input_size = crm.state_mean.numel() + crm.action_mean.numel() + crm.config.latent_dim
        self.network = mlp(input_size, config.hidden, 3, crm.state_mean.numel())

    def move(
        self,
        states: Tensor,
        actions: Tensor,
        z: Tensor,
    ) -> Tensor:
        """Moves Δ (M, S), in standard deviations of the states; 0 in dimensions that never vary."""
        (crm,) = self._crm
        move: Tensor = self.network(torch.cat([crm.given(states, actions), z], dim=-1))
        return move * (crm.state_std > 0)

    @torch.no_grad()
    def propose(
        self,
        at: Transitions,
        z: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """See `TangentGenerator.propose`; deterministic."""
        return at.states + self._crm[0].state_std * self.move(at.states, at.actions, z)


class NoiseGenerator:
    """A control: moves in random directions, with the lengths of `TangentGenerator`."""

    def __init__(self, crm: CausalRewardModel, config: CSGConfig) -> None:
        self._std, self.band = crm.state_std, config.band

    def propose(
        self,
        at: Transitions,
        z: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """See `TangentGenerator.propose`."""
        noise = torch.randn(at.states.shape, generator=generator).to(at.states.device)
        noise = noise * (self._std > 0)
        length = _lengths(self.band, at.states, generator)
        return at.states + self._std * _scale(noise, length, math.inf)


Generator = TangentGenerator | CounterfactualStateGenerator | NoiseGenerator
"""Proposes counterfactual states, which the acceptance gate then accepts or rejects."""


def state_clusters(
    train: Transitions,
    crm: CausalRewardModel,
    config: CSGConfig,
    seed: int,
) -> StateClusters:
    """Clusters of the states of the steps that `make_generator` fits to, with the same seed."""
    states = train.states[_high_rewards(train, config, seed)].to(crm.device)
    return StateClusters.of(crm.normalise_states(states).cpu(), config.clusters, seed)


@random_state_kept()
def make_generator(
    train: Transitions,
    crm: CausalRewardModel,
    config: CSGConfig,
    folder: Path,
    seed: int,
    clusters: StateClusters | None = None,
) -> Generator:
    """Make the generator of kind `config.kind`, fitted to the steps of `train` with high rewards.

    Args:
        crm: gives the device; its parameters are frozen if the kind is `faithful`.
        folder: of the checkpoints of `faithful`, which resumes from them.
        clusters: the `state_clusters` of the same arguments, if they are known.
    """
    if config.kind == "noise":
        return NoiseGenerator(crm, config)
    if config.kind == "tangent":
        clusters = clusters or state_clusters(train, crm, config, seed)
        return TangentGenerator(crm, clusters, config)
    return _fit_faithful(train, crm, config, folder, seed)


def _high_rewards(train: Transitions, config: CSGConfig, seed: int) -> Tensor:
    """Rows of the steps to fit to, in random order."""
    rewards = train.rewards.numpy()
    rows = np.flatnonzero(rewards >= np.quantile(rewards, config.reward_quantile))
    shuffled = np.random.default_rng(seed).permutation(rows)
    return torch.from_numpy(shuffled[: config.max_transitions])


def _fit_faithful(
    train: Transitions,
    crm: CausalRewardModel,
    config: CSGConfig,
    folder: Path,
    seed: int,
) -> CounterfactualStateGenerator:
    rows = _high_rewards(train, config, seed)
    logged = [part[rows].to(crm.device) for part in (train.states, train.actions, train.rewards)]
    torch.manual_seed(seed)
    csg = CounterfactualStateGenerator(crm, config).to(crm.device)
    low, high = config.band

    def draw(generator: np.random.Generator) -> tuple[Tensor, ...]:
        numbers = generator.integers(len(rows), size=config.batch_size)
        at = torch.from_numpy(numbers).to(crm.device)
        return tuple(values[at] for values in logged)

    def loss(batch: tuple[Tensor, ...]) -> tuple[Tensor, Mapping[str, Tensor]]:
        s, a, r = batch
        with torch.no_grad():
            z = crm.abduct(s, a, r)
        move = csg.move(s, a, z)
        reward = crm.predict(s + crm.state_std * move, a, z)
        # In standard deviations of the reward, so that λ does not depend on its scale.
        change = ((reward - r) / crm.reward_std).square().mean()
        length = move.norm(dim=1)
        below, above = (low - length).relu(), (length - high).relu()
        band = (below.square() + above.square()).mean()
        parts = {"reward_change": change.detach(), "band": band.detach()}
        return config.lambda_r * change + config.lambda_band * band, parts

    epoch = max(1, len(rows) // config.batch_size)
    loop = LoopConfig(
        steps=config.epochs * epoch,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        weight_decay=0.0,
        warmup_steps=0,
        clip_norm=0.0,
        validate_every=epoch,
        average=0.0,
    )
    crm.requires_grad_(False)
    fit(csg, draw, loss, loop, folder, seed=seed, describe="state generator")
    return csg


def _lengths(band: tuple[float, float], states: Tensor, generator: torch.Generator) -> Tensor:
    """(M, 1) lengths of moves from states (M, S), drawn from the band."""
    low, high = band
    shares = torch.rand(len(states), 1, generator=generator)
    return (low + (high - low) * shares).to(states.device)


def _products(matrices: Tensor, vectors: Tensor, rows: list[int]) -> Tensor:
    """Products (M, S) of matrices (C, S, S) with vectors (M, S), of which each has so many rows."""
    parts = zip(matrices, torch.split(vectors, rows), strict=True)
    return torch.cat([part @ matrix.T for matrix, part in parts])


def _ratio(change: Tensor, gradient: Tensor, steepest: Tensor) -> Tensor:
    """Step size (M, 1) against `steepest` that lowers the reward by `change` (M,), to 1st order."""
    return (change / ((gradient * steepest).sum(1) + _TINY)).unsqueeze(1)


def _scale(move: Tensor, length: Tensor, most: float = 1.0) -> Tensor:
    """The moves (M, S) with lengths (M, 1), but none longer than `most` times what it was."""
    factor: Tensor = length / (move.norm(dim=1, keepdim=True) + _TINY)
    return move * factor.clamp(max=most)
