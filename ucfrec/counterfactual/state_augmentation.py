"""Edited copies of episodes, and a report on their quality.

Rewards, actions, next states and returns-to-go of a copy are those of its source; an overlay holds
only the edited states (paper appendix H).
"""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.counterfactual.action_augmentation import ActionReport
from ucfrec.counterfactual.generators import Generator
from ucfrec.counterfactual.reward_model import CausalRewardModel
from ucfrec.counterfactual.reward_model_fit import CRMReport, Read, fit_warning
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Overlay, Transitions
from ucfrec.files.record import Undefinable
from ucfrec.settings import Count, Quantile, settings_table

_CHUNK = 8192
_DELTA_LEVEL = "0.95"
_ROUNDING = 1e-9
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_BINS = 20


@settings_table("augment")
class AugmentConfig:
    """How many copies are made, with other states or other actions, and of which steps.

    The paper's Algorithm 5 is `copies=K, edits_per_copy=1, reward_quantile=0`: each of K accepted
    proposals makes a separate copy. The default is appendix H: few copies that contain every
    accepted edit.
    """

    copies: Annotated[int, Field(ge=0, le=1000)] = 1
    """Maximum number of augmented episodes of each episode, whose states differ; 0 for none."""
    actions: Annotated[int, Field(ge=0, le=1000)] = 0
    """Number of other actions to propose at each step: a copy of the episode up to this step ends
    with the other action and its counterfactual reward, where the reward model is accurate enough.
    With neither actions nor copies, no reward model is fitted."""
    edits_per_copy: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Maximum number of edited steps in a copy; 0 means no limit."""
    reward_quantile: Quantile = 0.3
    """Steps with a reward below this quantile are neither edited nor given other actions."""
    epsilon_r: Annotated[float, Field(ge=0, le=1e15)] | None = None
    """ε_r, tolerance of the reward gate in reward units; unset, 0.1 × standard deviation of the
    rewards."""
    max_steps: Count = 2_000_000
    """Maximum number of steps to propose edits for; from a larger store, episodes are sampled."""

    @property
    def augments(self) -> bool:
        """Whether there are copies of any kind."""
        return self.copies > 0 or self.actions > 0

    def tolerance(self, crm: CausalRewardModel) -> float:
        """ε_r, in reward units."""
        return 0.1 * float(crm.reward_std) if self.epsilon_r is None else self.epsilon_r


@dataclass(frozen=True)
class MoveReport:
    """Moves Δ = (s_c − s) / σ_s of the accepted edits (paper appendix I.2)."""

    edits: int
    """Number of accepted edits."""
    length_quantiles: dict[str, float]
    """Quantiles of ‖Δ‖₂ by level; empty without edits."""
    histogram_edges: tuple[float, ...]
    """Edges of the bins of ‖Δ‖₂, from 0 to ρ_high."""
    histogram_counts: tuple[int, ...]
    """Number of edits in each bin."""
    mean_move_ratio: Undefinable
    """‖mean Δ‖ / mean ‖Δ‖: 1 if all edits are the same shift, near 0 if they are varied."""
    effective_rank: float
    """exp of the entropy of the spectrum of E[ΔΔᵀ]: effective number of directions of the moves."""
    dimensions: int
    """Number of state dimensions that vary in the training data; bounds the effective rank."""


class MoveStatistics:
    """Accumulates statistics of moves chunk by chunk, without keeping the moves."""

    def __init__(self, size: int) -> None:
        """
        Args:
            size: S, dimensions of a move.
        """
        self._total = torch.zeros(size, dtype=torch.float64)
        self._moments = torch.zeros(size, size, dtype=torch.float64)
        self._lengths: list[Tensor] = []

    def add(self, moves: Tensor) -> None:
        """Add the moves Δ (M, S) of M accepted edits."""
        moves = moves.double()
        self._total += moves.sum(dim=0)
        self._moments += moves.T @ moves
        self._lengths.append(moves.norm(dim=1))

    def report(self, rho_high: float, dimensions: int) -> MoveReport:
        """Summarise the moves added so far; if none has a length, ratio is NaN and rank 0.

        Args:
            rho_high: upper end of the histogram of lengths.
        """
        lengths = torch.cat([torch.zeros(0, dtype=torch.float64), *self._lengths]).numpy()
        counts, edges = np.histogram(lengths, bins=_BINS, range=(0.0, rho_high))
        moved = bool(lengths.sum() > 0)
        return MoveReport(
            edits=len(lengths),
            length_quantiles=_length_quantiles(lengths) if len(lengths) else {},
            histogram_edges=tuple(edges.tolist()),
            histogram_counts=tuple(counts.tolist()),
            mean_move_ratio=float(self._total.norm()) / lengths.sum() if moved else math.nan,
            effective_rank=_effective_rank(self._moments) if moved else 0.0,
            dimensions=dimensions,
        )


def _length_quantiles(values: Float64Array) -> dict[str, float]:
    return {f"{level:g}": float(np.quantile(values, level)) for level in _QUANTILES}


def _effective_rank(moments: Tensor) -> float:
    spectrum = torch.linalg.eigvalsh(moments).clamp(min=0)
    share = spectrum / spectrum.sum()
    return float(torch.exp(-torch.special.xlogy(share, share).sum()))


@dataclass(frozen=True)
class AugmentationReport:
    """Number and kind of the edits, and the bound of Proposition 1 on their effect."""

    copies: int
    """Number of augmented episodes."""
    proposals: int
    """Number of proposed edits."""
    acceptance: float
    """Share of proposals that passed both gates."""
    moves: MoveReport
    """Statistics of the accepted edits."""
    epsilon_r: float
    """Tolerance of the reward gate, in reward units."""
    delta: float
    """δ: the 95% quantile of |f̂_r(s, a, z) − r| on held-out steps, in reward units."""
    bound: float
    """δ + ε_r, in reward units: largest change of the true reward by an edit (Proposition 1)."""
    verdict: str
    """A sentence on whether the bound is informative."""
    warnings: tuple[str, ...]
    """Warnings of a reward model that predicts nothing, latent collapse, latent leak and edit
    collapse."""
    reward_model: CRMReport
    """Quality of the reward model."""
    actions: ActionReport | None = None
    """Action copies; None if no other action was proposed."""


def accept(
    crm: CausalRewardModel,
    factual: Transitions,
    z: Tensor,
    proposals: Tensor,
    epsilon_r: float,
    rho_high: float,
) -> Tensor:
    """Which proposals pass both gates of Eq. 4 (Algorithm 4).

    Args:
        factual: M logged steps.
        z: (M, latent_dim) disturbances abduced from them.
        proposals: (M, S) counterfactual states.
        epsilon_r: largest allowed |f̂_r(s_c, a, z) − r|, in reward units.
        rho_high: largest allowed ‖(s_c − s) / σ_s‖₂; dimensions with σ_s = 0 must not change.

    Returns:
        (M,) bool.
    """
    change = (crm.predict(proposals, factual.actions, z) - factual.rewards).abs()
    length = crm.moves(factual.states, proposals).norm(dim=1)
    passed: Tensor = (change <= epsilon_r) & (length <= rho_high)
    return passed


def augment(
    view: EpisodeStore,
    crm: CausalRewardModel,
    crm_report: CRMReport,
    generator: Generator,
    config: AugmentConfig,
    seed: int,
    read: Read = EpisodeStore.transitions,
) -> tuple[Overlay, AugmentationReport]:
    """Make augmented episodes of episodes (Algorithm 5, or appendix H; see `AugmentConfig`).

    Args:
        view: the training episodes, without augmented episodes.
        config: numbers of copies and edits, and the gate.
        read: reads transitions with the actions that the reward model was fitted to.
    """
    rng = np.random.default_rng(seed)
    editor = _Editor(view, crm, generator, config.tolerance(crm), seed, read)
    episodes, steps = candidates(view, config, rng)
    if config.edits_per_copy:
        rounds = _fill_copies(editor, episodes, steps, config, rng)
    else:
        rounds = (editor.edit(episodes, steps, copy=k) for k in range(config.copies))
    overlay = _overlay(view, _join(rounds, view.state_size), config.copies)
    return overlay, _report(overlay, editor, crm_report)


class _Edits(NamedTuple):
    """M accepted edits: position of the episode in the view, copy, step, state (M, S)."""

    episode: IntArray
    copy: IntArray
    step: IntArray
    state: Float32Array


class _Editor:
    """Proposes edits, applies the gates chunk by chunk, and collects statistics."""

    def __init__(
        self,
        view: EpisodeStore,
        crm: CausalRewardModel,
        generator: Generator,
        epsilon_r: float,
        seed: int,
        read: Read,
    ) -> None:
        self._view, self._crm, self._generator, self._read = view, crm, generator, read
        self._random = torch.Generator().manual_seed(seed)
        # The gates are evaluated in float64 on the stored float32 values, so that a later check
        # of an overlay confirms every edit.
        self._exact = copy.deepcopy(crm).double()
        self._moves = MoveStatistics(view.state_size)
        self.epsilon_r = epsilon_r
        self.rho_high = generator.band[1]
        self.proposals = 0

    def edit(self, episodes: IntArray, steps: IntArray, copy: int = 0) -> _Edits:
        """Propose one edit at each of the given steps; returns the accepted ones, in order."""
        accepted, states = np.zeros(len(steps), dtype=bool), []
        for start in range(0, len(steps), _CHUNK):
            rows = slice(start, start + _CHUNK)
            accepted[rows], edited = self._chunk(episodes[rows], steps[rows])
            states.append(edited)
        state = np.concatenate([np.zeros((0, self._view.state_size), np.float32), *states])
        return _Edits(
            episodes[accepted], np.full(int(accepted.sum()), copy), steps[accepted], state
        )

    @torch.no_grad()
    def _chunk(self, episodes: IntArray, steps: IntArray) -> tuple[BoolArray, Float32Array]:
        factual = self._read(self._view, episodes, steps).to(self._crm.device)
        z = self._crm.abduct(factual.states, factual.actions, factual.rewards)
        proposed = self._generator.propose(factual.states, factual.actions, z, self._random)
        exact = replace(
            factual,
            states=factual.states.double(),
            actions=factual.actions.double(),
            rewards=factual.rewards.double(),
        )
        exact_z = self._exact.abduct(exact.states, exact.actions, exact.rewards)
        gates = (self.epsilon_r * (1 - _ROUNDING), self.rho_high * (1 - _ROUNDING))
        passed = accept(self._exact, exact, exact_z, proposed.double(), *gates)
        self._moves.add(self._exact.moves(exact.states[passed], proposed[passed].double()).cpu())
        self.proposals += len(steps)
        return passed.cpu().numpy(), proposed[passed].cpu().numpy()

    def moves(self) -> MoveReport:
        return self._moves.report(self.rho_high, int((self._crm.state_std > 0).sum()))


def candidates(
    view: EpisodeStore, config: AugmentConfig, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """(episodes, steps), each (M,), that pass the reward filter, in order of episodes.

    Args:
        view: the training episodes, without copies.
        rng: draws episodes if there are too many steps.
    """
    order = rng.permutation(view.n_episodes)
    count = np.searchsorted(np.cumsum(view.lengths[order]), config.max_steps, side="right")
    sampled = np.sort(order[: max(1, int(count))])
    lengths = view.lengths[sampled]
    episodes, steps = np.repeat(sampled, lengths), _ranges(np.zeros_like(lengths), lengths)
    rewards = view.step_values(schema.REWARD, episodes, steps)
    high = rewards >= np.quantile(rewards, config.reward_quantile)
    return episodes[high], steps[high]


def _fill_copies(
    editor: _Editor,
    episodes: IntArray,
    steps: IntArray,
    config: AugmentConfig,
    rng: np.random.Generator,
) -> Iterator[_Edits]:
    """Propose at each episode's steps in random order until its copies are full (Algorithm 5).

    In each round every episode proposes as many edits as its copies still need, so no edit is
    proposed that the algorithm, which proceeds one step at a time, would not propose.
    """
    order = np.lexsort((rng.random(len(steps)), episodes))
    unique_episodes, counts = np.unique(episodes, return_counts=True)
    first = np.cumsum(counts) - counts
    proposed, accepted = np.zeros_like(counts), np.zeros_like(counts)
    while True:
        needed = config.copies * config.edits_per_copy - accepted
        new_proposals = np.minimum(needed, counts - proposed)
        if not new_proposals.any():
            return
        rows = order[_ranges(first + proposed, new_proposals)]
        edits = editor.edit(episodes[rows], steps[rows])
        index = np.searchsorted(unique_episodes, edits.episode)
        new_edits = np.bincount(index, minlength=len(counts))
        number = _ranges(accepted, new_edits)
        yield edits._replace(copy=number // config.edits_per_copy)
        proposed, accepted = proposed + new_proposals, accepted + new_edits


def _ranges(starts: IntArray, lengths: IntArray) -> IntArray:
    """The concatenated ranges start, start + 1, …, start + length − 1."""
    ends = np.cumsum(lengths)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - ends + lengths, lengths)


def _join(rounds: Iterator[_Edits], state_size: int) -> _Edits:
    no_index = np.zeros(0, dtype=np.int64)
    empty = _Edits(no_index, no_index, no_index, np.zeros((0, state_size), dtype=np.float32))
    return _Edits(*(np.concatenate(parts) for parts in zip(empty, *rounds, strict=True)))


def _overlay(view: EpisodeStore, edits: _Edits, copies: int) -> Overlay:
    copy_keys, edit_copy = np.unique(edits.episode * copies + edits.copy, return_inverse=True)
    order = np.lexsort((edits.step, edit_copy))
    return Overlay(
        copy_source=view.episode_ids[copy_keys // copies],
        edit_copy=edit_copy[order],
        edit_step=edits.step[order],
        edit_state=edits.state[order],
    )


def _report(overlay: Overlay, editor: _Editor, crm_report: CRMReport) -> AugmentationReport:
    moves = editor.moves()
    delta = crm_report.delta[_DELTA_LEVEL]
    bound = delta + editor.epsilon_r
    model_warnings = (fit_warning(crm_report.r2_without_z), crm_report.warning)
    warnings = [warning for warning in model_warnings if warning]
    if moves.edits and moves.mean_move_ratio > 0.5:
        warnings.append(
            f"edit collapse: {moves.mean_move_ratio:.0%} of the average edit is one shift common "
            f"to all states (effective rank {moves.effective_rank:.1f} of {moves.dimensions})"
        )
    return AugmentationReport(
        copies=len(overlay.copy_source),
        proposals=editor.proposals,
        acceptance=moves.edits / max(1, editor.proposals),
        moves=moves,
        epsilon_r=editor.epsilon_r,
        delta=delta,
        bound=bound,
        verdict=_verdict(editor.proposals, moves.edits, bound, crm_report),
        warnings=tuple(warnings),
        reward_model=crm_report,
    )


def _verdict(proposals: int, edits: int, bound: float, crm_report: CRMReport) -> str:
    if proposals == 0:
        return "no state is edited"
    if edits == 0:
        return (
            "no edit was accepted: the reward model's median error on held-out steps is "
            f"{crm_report.delta['0.5']:.3g}, or the generator changes the predicted reward"
        )
    deviations = bound / crm_report.reward_std
    if deviations >= 1:
        return (
            f"the bound means nothing: it allows a change of {bound:.3g}, {deviations:.1f} "
            "standard deviations of the reward; the reward model is too inaccurate"
        )
    return (
        f"an accepted edit changes the true reward by at most {bound:.3g} ({deviations:.2f} "
        "standard deviations), provided that the reward model is as accurate at edited states as "
        "on 95% of held-out steps"
    )
