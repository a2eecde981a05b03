"""Offline counterfactual augmentation: edited copies of episodes, and what they can be trusted for.

Rewards, actions, next states and returns-to-go of a copy are its source's: an overlay holds edited
states and nothing else (paper appendix H).
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field
from torch import Tensor

from ucfrec import schema
from ucfrec.counterfactual.edit_statistics import MoveReport, MoveStatistics
from ucfrec.counterfactual.generators import CSGConfig, Generator, make_generator
from ucfrec.counterfactual.reward_model import (
    CausalRewardModel,
    CRMConfig,
    CRMReport,
    fit_crm,
    fit_warning,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import FloatArray, IntArray, Overlay, Transitions
from ucfrec.errors import InputError
from ucfrec.fitting.random_state import random_state_kept
from ucfrec.settings import Count, Quantile, settings_table

_CHUNK = 8192
_DELTA_LEVEL = "0.95"
_ROUNDING = 1e-9


@settings_table("augment")
class AugmentConfig:
    """How many edited copies are made, and of which steps.

    Algorithm 5 is `copies=K, edits_per_copy=1, reward_quantile=0`: each of K accepted proposals
    makes its own copy. Appendix H, the default, is few copies that carry every accepted edit.
    """

    copies: Annotated[int, Field(ge=0, le=1000)] = 1
    """Edited copies of each episode, at most; 0 trains without, and without a reward model."""
    edits_per_copy: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Edited steps in a copy, at most; 0 stands for every accepted one."""
    reward_quantile: Quantile = 0.3
    """Steps with a reward below this quantile are left alone."""
    epsilon_r: Annotated[float, Field(ge=0, le=1e15)] | None = None
    """Tolerance of the gate in reward units; unset, 0.1 × standard deviation of the rewards."""
    max_steps: Count = 2_000_000
    """Most steps to look at; of a larger store, episodes are drawn."""


@dataclass(frozen=True)
class AugmentationReport:
    """What was edited, and what Proposition 1 promises for it."""

    copies: int
    proposals: int
    acceptance: float
    """Share of proposals that passed the gate."""
    moves: MoveReport
    epsilon_r: float
    delta: float
    """What |f̂_r(s, a, z) − r| stays below on 95% of held-out steps."""
    bound: float
    """δ + ε_r, in reward units: how far an edit may have moved the true reward."""
    verdict: str
    """In plain words, what the bound is worth."""
    warnings: tuple[str, ...]
    """A reward model that predicts nothing, latent collapse or leak, edit collapse."""
    reward_model: CRMReport


def accept(
    crm: CausalRewardModel,
    factual: Transitions,
    z: Tensor,
    proposals: Tensor,
    epsilon_r: float,
    rho_high: float,
) -> Tensor:
    """Which proposals pass both gates of Eq. 4 (Algorithm 4), as bools (M,).

    Args:
        factual: M steps as they were logged.
        z: (M, latent_dim) disturbances abduced from them.
        proposals: (M, S) counterfactual states.
        epsilon_r: largest |f̂_r(s_c, a, z) − r|, in reward units.
        rho_high: largest ‖(s_c − s) / σ_s‖₂; dimensions with σ_s = 0 must not move at all.
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
) -> tuple[Overlay, AugmentationReport]:
    """Edited copies of the episodes of `view`, a training view without an overlay (Algorithm 5).

    Raises:
        InputError: `config` has no copies.
    """
    if config.copies < 1:
        raise InputError("augment.copies is 0; to make copies, it must be at least 1")
    rng = np.random.default_rng(seed)
    epsilon_r = config.epsilon_r
    if epsilon_r is None:
        epsilon_r = 0.1 * float(crm.reward_std)
    editor = _Editor(view, crm, generator, epsilon_r, seed)
    episodes, steps = _candidates(view, config, rng)
    if config.edits_per_copy:
        rounds = _deal(editor, episodes, steps, config, rng)
    else:
        rounds = (editor.edit(episodes, steps, copy=k) for k in range(config.copies))
    overlay = _overlay(view, _join(rounds, view.state_size), config.copies)
    return overlay, _report(overlay, editor, crm_report)


def require_rewards_vary(train: EpisodeStore) -> None:
    """Refuse training episodes whose rewards are all equal: a reward model has nothing to learn.

    Raises:
        InputError: they are.
    """
    rewards = train.step_values(schema.REWARD, *train.all_steps())
    if (rewards == rewards[0]).all():
        raise InputError(
            f"all {len(rewards):,} training rewards of {train.path} equal {rewards[0]:g}: there is "
            "nothing for a reward model to learn; check the reward expression, or set "
            "augment.copies=0"
        )


@random_state_kept()
def counterfactual_copies(
    train: EpisodeStore,
    validation: EpisodeStore,
    crm_config: CRMConfig,
    csg_config: CSGConfig,
    config: AugmentConfig,
    folder: Path,
    seed: int,
) -> tuple[Overlay, AugmentationReport]:
    """Lines 1 to 3 of Algorithm 1: reward model, generator, edited copies.

    Args:
        train: view that everything is learned from and copies are made of.
        validation: view that only measures the reward model and stops its training.
        folder: where checkpoints are kept; resumed from if there are some.
    """
    most = max(crm_config.max_transitions, csg_config.max_transitions)
    fitted = sample_transitions(train, most, seed)
    held_out = sample_transitions(validation, most // 10, seed)
    crm, crm_report = fit_crm(fitted, held_out, crm_config, folder / "crm", seed)
    generator = make_generator(fitted, crm, csg_config, folder / "csg", seed)
    return augment(train, crm, crm_report, generator, config, seed)


def sample_transitions(view: EpisodeStore, limit: int, seed: int) -> Transitions:
    """All transitions of a view, or `limit` drawn from them if there are more."""
    if view.n_steps <= limit:
        return view.transitions(*view.all_steps())
    return view.transitions(*view.draw_steps(np.random.default_rng(seed), limit))


class _Edits(NamedTuple):
    """Accepted edits, aligned; episodes are positions in the view."""

    episode: IntArray
    copy: IntArray
    step: IntArray
    state: FloatArray


class _Editor:
    """Proposes and judges chunk by chunk, and keeps count."""

    def __init__(
        self,
        view: EpisodeStore,
        crm: CausalRewardModel,
        generator: Generator,
        epsilon_r: float,
        seed: int,
    ) -> None:
        self._view, self._crm, self._generator = view, crm, generator
        self._random = torch.Generator().manual_seed(seed)
        # Judged in float64 as stored in float32, so that whoever checks finds both gates hold.
        self._exact = copy.deepcopy(crm).double()
        self._moves = MoveStatistics(view.state_size)
        self.epsilon_r = epsilon_r
        self.rho_high = generator.band[1]
        self.proposals = 0

    def edit(self, episodes: IntArray, steps: IntArray, copy: int = 0) -> _Edits:
        """Propose once at each of the given steps; the accepted edits, in the given order."""
        kept, states = np.zeros(len(steps), dtype=bool), []
        for start in range(0, len(steps), _CHUNK):
            rows = slice(start, start + _CHUNK)
            kept[rows], edited = self._chunk(episodes[rows], steps[rows])
            states.append(edited)
        state = np.concatenate([np.zeros((0, self._view.state_size), np.float32), *states])
        return _Edits(episodes[kept], np.full(int(kept.sum()), copy), steps[kept], state)

    @torch.no_grad()
    def _chunk(
        self, episodes: IntArray, steps: IntArray
    ) -> tuple[npt.NDArray[np.bool_], FloatArray]:
        factual = self._view.transitions(episodes, steps)
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
        self._moves.add(self._exact.moves(exact.states[passed], proposed[passed].double()))
        self.proposals += len(steps)
        return passed.numpy(), proposed[passed].numpy()

    def moves(self) -> MoveReport:
        return self._moves.report(self.rho_high, int((self._crm.state_std > 0).sum()))


def _candidates(
    view: EpisodeStore, config: AugmentConfig, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """(episodes, steps) that pass the reward filter, by episode."""
    order = rng.permutation(view.n_episodes)
    fitting = np.searchsorted(np.cumsum(view.lengths[order]), config.max_steps, side="right")
    chosen = np.sort(order[: max(1, int(fitting))])
    lengths = view.lengths[chosen]
    episodes, steps = np.repeat(chosen, lengths), _ranges(np.zeros_like(lengths), lengths)
    rewards = view.step_values(schema.REWARD, episodes, steps)
    high = rewards >= np.quantile(rewards, config.reward_quantile)
    return episodes[high], steps[high]


def _deal(
    editor: _Editor,
    episodes: IntArray,
    steps: IntArray,
    config: AugmentConfig,
    rng: np.random.Generator,
) -> Iterator[_Edits]:
    """Propose at each episode's steps in random order until its copies are full (Algorithm 5).

    In each round every episode proposes exactly as often as it still lacks edits, so nothing is
    proposed that the algorithm, one step at a time, would not have.
    """
    order = np.lexsort((rng.random(len(steps)), episodes))
    found_in, counts = np.unique(episodes, return_counts=True)
    first = np.cumsum(counts) - counts
    tried, accepted = np.zeros_like(counts), np.zeros_like(counts)
    while True:
        lacking = config.copies * config.edits_per_copy - accepted
        trying = np.minimum(lacking, counts - tried)
        if not trying.any():
            return
        rows = order[_ranges(first + tried, trying)]
        edits = editor.edit(episodes[rows], steps[rows])
        which = np.searchsorted(found_in, edits.episode)
        new = np.bincount(which, minlength=len(counts))
        number = _ranges(accepted, new)
        yield edits._replace(copy=number // config.edits_per_copy)
        tried, accepted = tried + trying, accepted + new


def _ranges(starts: IntArray, lengths: IntArray) -> IntArray:
    """start, start + 1, …, start + length − 1 for each pair, one after the other."""
    ends = np.cumsum(lengths)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - ends + lengths, lengths)


def _join(rounds: Iterator[_Edits], state_size: int) -> _Edits:
    none = np.zeros(0, dtype=np.int64)
    empty = _Edits(none, none, none, np.zeros((0, state_size), dtype=np.float32))
    return _Edits(*(np.concatenate(parts) for parts in zip(empty, *rounds, strict=True)))


def _overlay(view: EpisodeStore, edits: _Edits, copies: int) -> Overlay:
    made, edit_copy = np.unique(edits.episode * copies + edits.copy, return_inverse=True)
    order = np.lexsort((edits.step, edit_copy))
    return Overlay(
        copy_source=view.episode_ids[made // copies],
        edit_copy=edit_copy[order],
        edit_step=edits.step[order],
        edit_state=edits.state[order],
    )


def _report(overlay: Overlay, editor: _Editor, crm_report: CRMReport) -> AugmentationReport:
    moves = editor.moves()
    delta = crm_report.delta[_DELTA_LEVEL]
    bound = delta + editor.epsilon_r
    of_model = (fit_warning(crm_report.r2_without_z), crm_report.warning)
    warnings = [warning for warning in of_model if warning]
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
        verdict=_verdict(moves.edits, bound, crm_report),
        warnings=tuple(warnings),
        reward_model=crm_report,
    )


def _verdict(edits: int, bound: float, crm_report: CRMReport) -> str:
    if edits == 0:
        return (
            "no edit was accepted: the reward model misses held-out rewards by "
            f"{crm_report.delta['0.5']:.3g} in the median, or the generator changes them"
        )
    deviations = bound / crm_report.reward_std
    if deviations >= 1:
        return (
            f"the bound means nothing: it allows a change of {bound:.3g}, {deviations:.1f} "
            "standard deviations of the reward; the reward model is too poor"
        )
    return (
        f"an accepted edit changes the true reward by at most {bound:.3g} ({deviations:.2f} "
        "standard deviations), as far as the reward model is as good at edited states as on 95% "
        "of held-out steps"
    )
