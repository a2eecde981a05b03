"""Edits and attention of a finished run, read from its folder without any training."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ucfrec.arrays import Float64Array
from ucfrec.counterfactual.augmentation import AugmentationReport, accept
from ucfrec.counterfactual.generators import (
    CounterfactualStateGenerator,
    TangentGenerator,
    make_generator,
)
from ucfrec.counterfactual.reward_model import CausalRewardModel, sample_steps
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AUGMENTED, AugmentedEpisodes, Transitions
from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, load_weights
from ucfrec.policies.ucf import UCFPolicy
from ucfrec.runs.record import RunRecord, read_augmentation
from ucfrec.runs.record import store_of as trained_store
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy

_REPORT = "augmentation.json"
_PROPOSALS = 4096
_WINDOWS = 512
_POINTS = 3000
_ROUNDING = 1e-5
"""Of a move's length in float32: what the generator scales to a bound is within it."""


def store_of(run: Path) -> EpisodeStore:
    """The store that a run was trained on, without dropped dimensions. InputError if the store was
    moved, removed or changed."""
    record = RunRecord.read(run)
    store = trained_store(run, record)
    if store is None:
        raise InputError(
            f"{run} was trained on {record.store}, which is gone or has changed; move the run "
            "together with its store, or train again"
        )
    return store.without_observation_dimensions(record.dropped_observations)


def is_augmented(run: Path) -> bool:
    """Whether augmented episodes were made for a run."""
    return (run / _REPORT).exists() and read_augmentation(run / _REPORT).proposals > 0


def edit_states(run: Path, seed: int = 0) -> tuple[Float64Array, Float64Array]:
    """Factual states and their edits, (M, S) each, aligned and in standard deviations from the
    training mean; at most 3,000 drawn from a run's counterfactual copies. InputError if the run
    made no copies, or no edit of them was accepted, or its store is gone."""
    _augmentation(run)
    store = store_of(run)
    copies = AugmentedEpisodes.load(run / AUGMENTED)
    rng, edits = np.random.default_rng(seed), len(copies.edit_step)
    if not edits:
        raise InputError(f"{run}: no edit of a state was accepted")
    rows = rng.choice(edits, min(edits, _POINTS), replace=False)
    episodes = copies.copy_source[copies.edit_copy[rows]]
    factual = store.windows(episodes, copies.edit_step[rows], 1).states[:, 0]
    mean, std = training_views(store)[0].state_statistics
    # Constant dimensions are never edited.
    varies = std > 0
    edited = torch.from_numpy(copies.edit_state[rows])
    scaled = [((s - mean) / std)[:, varies].double().numpy() for s in (factual, edited)]
    return scaled[0], scaled[1]


@dataclass(frozen=True)
class Editing:
    """The models that made a run's edits, and steps drawn from its training episodes."""

    crm: CausalRewardModel
    generator: TangentGenerator | CounterfactualStateGenerator
    factual: Transitions
    epsilon_r: float
    """Tolerance of the reward gate, in reward units."""

    @classmethod
    def of(cls, run: Path, seed: int = 0) -> "Editing":
        """Read back the models of `run`, and draw 4,096 of the steps that it could have edited.
        InputError if the run made no copies, or its models or its store are gone."""
        record, report = RunRecord.read(run), _augmentation(run)
        config, sizes = record.config, record.sizes
        train = training_views(store_of(run))[0]
        crm = CausalRewardModel(sizes["state"], sizes["action"], config.crm)
        weights = run / "crm" / "cvae" / "best.safetensors"
        load_weights(weights, crm, load_tensors(weights)[0])
        crm.eval().requires_grad_(False)
        limit = max(config.crm.max_transitions, config.csg.max_transitions)
        episodes, steps = sample_steps(train, limit, config.seed)
        fitted = train.transitions(episodes, steps)
        high = fitted.rewards >= fitted.rewards.quantile(config.augment.reward_quantile)
        rng = np.random.default_rng(seed)
        rows = torch.from_numpy(rng.permutation(np.flatnonzero(high.numpy()))[:_PROPOSALS])
        factual = Transitions(**{name: values[rows] for name, values in vars(fitted).items()})
        if config.csg.kind == "faithful":
            faithful = CounterfactualStateGenerator(crm, config.csg)
            weights = run / "csg" / "best.safetensors"
            load_weights(weights, faithful, load_tensors(weights)[0])
            return cls(crm, faithful.eval(), factual, report.epsilon_r)
        # Nothing of it is learned but covariances, the same for the same seed.
        tangent = make_generator(fitted, crm, config.csg, run / "csg", config.seed)
        assert isinstance(tangent, TangentGenerator)
        return cls(crm, tangent, factual, report.epsilon_r)

    def acceptance(self, band: tuple[float, float], seed: int = 0) -> float:
        """Share of proposals under `band` (ρ_low, ρ_high) that pass both gates of Eq. 4 and move
        by ρ_low or more.

        The tangent generator proposes moves of this band; the faithful network proposes what it
        learned to, whatever the band.
        """
        generator = self.generator
        if isinstance(generator, TangentGenerator):
            generator = copy.copy(generator)
            generator.band = band
        factual = self.factual
        random = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            z = self.crm.abduct(factual.states, factual.actions, factual.rewards)
            proposed = generator.propose(factual, z, random)
            passed = accept(self.crm, factual, z, proposed, self.epsilon_r, band[1] + _ROUNDING)
            length = self.crm.moves(factual.states, proposed).norm(dim=1)
        return float((passed & (length >= band[0] - _ROUNDING)).float().mean())


def acceptance_grid(run: Path, lows: Sequence[float], highs: Sequence[float]) -> Float64Array:
    """(lows, highs) acceptance under every band; NaN where ρ_low is not below ρ_high. InputError as
    `Editing.of`."""
    editing = Editing.of(run)
    return np.array(
        [[editing.acceptance((a, b)) if a < b else np.nan for b in highs] for a in lows]
    )


def move_histogram(run: Path) -> tuple[tuple[float, ...], tuple[int, ...], tuple[float, float]]:
    """Edges, counts and the band (ρ_low, ρ_high) of a run's accepted edits, by ‖Δ‖₂. InputError if
    the run made no copies."""
    moves = _augmentation(run).moves
    return moves.histogram_edges, moves.histogram_counts, RunRecord.read(run).config.csg.band


def attention(run: Path, seed: int = 0) -> Float64Array:
    """(K, 3, K) attention of a UCF run from s_t to R, s and a of every step.

    The mean over heads and over full windows of validation episodes; a row sums to one. InputError
    if the policy is not UCF, no episode fills a window, or the store is gone.
    """
    trained = TrainedPolicy.load(run)
    if not isinstance(trained.policy, UCFPolicy):
        raise InputError(f"{run} is of {trained.name}; attention is drawn of ucf and ucf-paper")
    view, k = training_views(store_of(run))[1], trained.policy.config.context
    episodes, ends = view.all_steps()
    full = np.flatnonzero(ends >= k - 1)
    if len(full) == 0:
        raise InputError(f"{run}: no validation episode has {k} steps, as many as a window")
    rows = np.random.default_rng(seed).choice(full, min(len(full), _WINDOWS), replace=False)
    windows = view.windows(episodes[rows], ends[rows], k)
    with torch.no_grad():
        weights = trained.policy.attend(trained.policy.normalize(windows))[1]
    # (B, H, K, 3K), tokens in the order R_0, s_0, a_0, R_1, …
    mean = weights.double().mean(dim=(0, 1)).view(k, k, 3).transpose(1, 2)
    return np.asarray(mean)


def _augmentation(run: Path) -> AugmentationReport:
    if not is_augmented(run):
        raise InputError(
            f"{run} has no augmented episodes; train it with augment.copies of 1 or more"
        )
    return read_augmentation(run / _REPORT)
