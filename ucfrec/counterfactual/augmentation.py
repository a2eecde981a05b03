"""Counterfactual copies of the training episodes: reward model, generator, gates (Algorithm 1).
All of an edited copy but its states is its source's (paper appendix H); an action copy ends with
another action and its counterfactual reward."""

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.counterfactual.generators import (
    ActionSupport,
    CSGConfig,
    Generator,
    StateClusters,
    make_generator,
    state_clusters,
)
from ucfrec.counterfactual.reward_model import (
    CausalRewardModel,
    CRMConfig,
    CRMReport,
    fit_crm,
    fit_warning,
    sample_steps,
)
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes, Transitions
from ucfrec.errors import InputError
from ucfrec.files.record import Undefinable
from ucfrec.processes import random_state_kept
from ucfrec.settings import Count, Quantile, settings_table

CRM = "crm"
"""Folder of the reward model."""
MODELS = (CRM, "csg")
"""Folders of the checkpoints of `augment_episodes`, as far as the settings need them."""
_CPU = torch.device("cpu")
_CHUNK, _ACTION_CHUNK = 8192, 4096
_ACTION_STREAM = 1
"""Keeps the draws of actions apart from others with the same seed."""
_DELTA_LEVEL = "0.95"
_LESS = 1 - 1e-9
"""Factor of a gate's limits, so that a rounding error does not let a proposal pass."""
_QUANTILES, _BINS = (0.05, 0.25, 0.5, 0.75, 0.95), 20
_Edits = tuple[IntArray, IntArray, IntArray, Float32Array]
"""M accepted edits: position of the episode in the view, copy, step, state (M, S)."""


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


@dataclass(frozen=True)
class MoveReport:
    """Moves Δ = (s_c − s) / σ_s of the accepted edits (paper appendix I.2)."""

    edits: int
    length_quantiles: dict[str, float]
    """Quantiles of ‖Δ‖₂ by level; empty without edits."""
    histogram_edges: tuple[float, ...]
    """Edges of the bins of ‖Δ‖₂, from 0 to ρ_high."""
    histogram_counts: tuple[int, ...]
    mean_move_ratio: Undefinable
    """‖mean Δ‖ / mean ‖Δ‖: 1 if all edits are the same shift, near 0 if they are varied."""
    effective_rank: float
    """exp of the entropy of the spectrum of E[ΔΔᵀ]: effective number of directions of the moves."""
    dimensions: int
    """Number of state dimensions that vary in the training data; bounds the effective rank."""


@dataclass(frozen=True)
class ActionReport:
    """Other actions that were proposed, and their counterfactual rewards."""

    proposals: int
    reproduced: float
    """Share of the proposals at steps whose logged reward the model reproduces within ε_r."""
    copies: int
    """Number of action copies: those that, at such steps, change the reward by more than δ."""
    mean_change: Undefinable
    """Mean change of the reward in the copies, in reward units; 0 without copies."""
    earns_more: Undefinable
    """Share of the copies with a higher reward than the logged action; 0 without copies."""


@dataclass(frozen=True)
class AugmentationReport:
    """Number and kind of the edits, and the bound of Proposition 1 on their effect."""

    copies: int
    """Number of augmented episodes."""
    proposals: int
    acceptance: float
    """Share of proposals that passed both gates."""
    moves: MoveReport
    epsilon_r: float
    """Tolerance of the reward gate, in reward units."""
    delta: float
    """δ: the 95% quantile of |f̂_r(s, a, z) − r| on held-out steps, in reward units."""
    bound: float
    """δ + ε_r, in reward units: largest change of the true reward by an edit (Proposition 1)."""
    verdict: str
    """A sentence on whether the bound is informative."""
    warnings: tuple[str, ...]
    """Of a reward model that predicts nothing, latent collapse, latent leak and edit collapse."""
    reward_model: CRMReport
    actions: ActionReport | None = None
    """Action copies; None if no other action was proposed."""


def require_rewards_vary(train: EpisodeStore) -> None:
    """InputError if all training rewards are equal, which a reward model cannot learn from."""
    rewards = train.column(schema.REWARD)
    if rewards.min() == rewards.max():
        raise InputError(
            f"all {train.n_steps:,} training rewards of {train.path} equal {rewards[0]:g}: there "
            "is nothing for a reward model to learn; check the rewards, or set augment.copies=0"
        )


@random_state_kept()
def augment_episodes(
    train: EpisodeStore,
    validation: EpisodeStore,
    crm_config: CRMConfig,
    csg_config: CSGConfig,
    config: AugmentConfig,
    folder: Path,
    seed: int,
    device: torch.device = _CPU,
) -> tuple[AugmentedEpisodes, AugmentationReport]:
    """Fit reward model and generator, and make copies (lines 1 to 3 of Algorithm 1) of the episodes
    of `train`; those of `validation` stop the fit early. Training resumes from `folder`."""
    limit = max(crm_config.max_transitions, csg_config.max_transitions)
    sampled_episodes, sampled_steps = sample_steps(train, limit, seed)
    training = train.transitions(sampled_episodes, sampled_steps)
    held_out_episodes, held_out_steps = sample_steps(validation, limit // 10, seed)
    held_out = validation.transitions(held_out_episodes, held_out_steps)
    crm, crm_report = fit_crm(training, held_out, crm_config, folder / CRM, seed, device)
    if not config.copies:
        # Nothing proposes states, so no generator is trained.
        csg_config = replace(csg_config, kind="noise")
    clusters = None
    if config.actions or csg_config.kind == "tangent":
        clusters = state_clusters(training, crm, csg_config, seed)
    generator = make_generator(training, crm, csg_config, folder / "csg", seed, clusters)
    episodes, report = edit_states(train, crm, crm_report, generator, config, seed)
    if clusters is None or not config.actions:
        return episodes, report
    states = crm.normalise_states(training.states.to(device)).cpu()
    labels = clusters.nearest(states).numpy()
    support = ActionSupport(labels, read_actions(train, sampled_episodes, sampled_steps))
    actions = ActionGenerator(train, crm, clusters, support, report.epsilon_r, report.delta)
    copied, steps = find_candidates(train, config, np.random.default_rng(seed))
    copies, actions_report = actions.propose(copied, steps, config.actions, seed)
    return episodes.join(copies), replace(report, actions=actions_report)


def find_candidates(
    view: EpisodeStore, config: AugmentConfig, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """(episodes, steps), each (M,), that pass the reward filter, in order of episodes, which are
    drawn if there are too many steps."""
    order = rng.permutation(view.n_episodes)
    count = np.searchsorted(np.cumsum(view.lengths[order]), config.max_steps, side="right")
    sampled = np.sort(order[: max(1, int(count))])
    lengths = view.lengths[sampled]
    episodes = np.repeat(sampled, lengths)
    steps = _ranges(np.zeros_like(lengths), lengths)
    rewards = view.step_values(schema.REWARD, episodes, steps)
    high = rewards >= np.quantile(rewards, config.reward_quantile)
    return episodes[high], steps[high]


def _ranges(starts: IntArray, lengths: IntArray) -> IntArray:
    """The concatenated ranges start, start + 1, …, start + length − 1."""
    ends = np.cumsum(lengths)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - ends + lengths, lengths)


# Other states.


def edit_states(
    view: EpisodeStore,
    crm: CausalRewardModel,
    crm_report: CRMReport,
    generator: Generator,
    config: AugmentConfig,
    seed: int,
) -> tuple[AugmentedEpisodes, AugmentationReport]:
    """Copy training episodes with other states (Algorithm 5, or appendix H: `AugmentConfig`)."""
    rng, random = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    # The gates are evaluated in float64 on the stored float32 values, so that a later check of the
    # edits confirms every one.
    exact, moves = copy.deepcopy(crm).double(), MoveStatistics(view.state_size)
    epsilon_r = 0.1 * float(crm.reward_std) if config.epsilon_r is None else config.epsilon_r
    rho_high = generator.band[1]

    @torch.no_grad()
    def edit(episodes: IntArray, steps: IntArray, number: int = 0) -> _Edits:
        """Propose one edit at each of the given steps; returns the accepted ones, in order."""
        accepted = np.zeros(len(steps), dtype=bool)
        states = [np.zeros((0, view.state_size), np.float32)]
        for start in range(0, len(steps), _CHUNK):
            rows = slice(start, start + _CHUNK)
            factual = view.transitions(episodes[rows], steps[rows]).to(crm.device)
            s, a, r = factual.states, factual.actions, factual.rewards
            proposed = generator.propose(factual, crm.abduct(s, a, r), random)
            s, a, r = s.double(), a.double(), r.double()
            factual = replace(factual, states=s, actions=a, rewards=r)
            z = exact.abduct(s, a, r)
            proposals = proposed.double()
            passed = accept(exact, factual, z, proposals, epsilon_r * _LESS, rho_high * _LESS)
            moves.add(exact.moves(s[passed], proposals[passed]).cpu())
            accepted[rows] = passed.cpu().numpy()
            states.append(proposed[passed].cpu().numpy())
        moves.proposals += len(steps)
        copies = np.full(int(accepted.sum()), number)
        return episodes[accepted], copies, steps[accepted], np.concatenate(states)

    episodes, steps = find_candidates(view, config, rng)
    if config.edits_per_copy:
        rounds = list(_fill_copies(edit, episodes, steps, config, rng))
    else:
        rounds = [edit(episodes, steps, number) for number in range(config.copies)]
    rounds.append(edit(episodes[:0], steps[:0]))
    edited, numbers, at, states = map(np.concatenate, zip(*rounds, strict=True))
    copies = max(config.copies, 1)
    copy_keys, edit_copy = np.unique(edited * copies + numbers, return_inverse=True)
    order = np.lexsort((at, edit_copy))
    augmented = AugmentedEpisodes(
        copy_source=view.episode_ids[copy_keys // copies],
        edit_copy=edit_copy[order],
        edit_step=at[order],
        edit_state=states[order],
    )
    report = moves.report(rho_high, int((crm.state_std > 0).sum()))
    return augmented, _report(len(copy_keys), moves.proposals, report, epsilon_r, crm_report)


def accept(
    crm: CausalRewardModel,
    factual: Transitions,
    z: Tensor,
    proposals: Tensor,
    epsilon_r: float,
    rho_high: float,
) -> Tensor:
    """Which proposals (M, S) for M logged steps with abduced z (M, latent_dim) pass both gates of
    Eq. 4 (Algorithm 4), (M,) bool: |f̂_r(s_c, a, z) − r| ≤ ε_r, in reward units, and
    ‖(s_c − s) / σ_s‖₂ ≤ ρ_high; dimensions with σ_s = 0 must not change."""
    change = (crm.predict(proposals, factual.actions, z) - factual.rewards).abs()
    length = crm.moves(factual.states, proposals).norm(dim=1)
    passed: Tensor = (change <= epsilon_r) & (length <= rho_high)
    return passed


def _fill_copies(
    edit: Callable[[IntArray, IntArray], _Edits],
    episodes: IntArray,
    steps: IntArray,
    config: AugmentConfig,
    rng: np.random.Generator,
) -> Iterator[_Edits]:
    """Propose at each episode's steps in random order until its copies are full (Algorithm 5): in
    each round as many edits as they still need, which the algorithm would propose one by one."""
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
        edited, _, at, states = edit(episodes[rows], steps[rows])
        index = np.searchsorted(unique_episodes, edited)
        new_edits = np.bincount(index, minlength=len(counts))
        number = _ranges(accepted, new_edits)
        yield edited, number // config.edits_per_copy, at, states
        proposed, accepted = proposed + new_proposals, accepted + new_edits


class MoveStatistics:
    """Counts proposals, and accumulates statistics of moves (M, S) without keeping the moves."""

    def __init__(self, size: int) -> None:
        self._total = torch.zeros(size, dtype=torch.float64)
        self._moments = torch.zeros(size, size, dtype=torch.float64)
        self._lengths = [torch.zeros(0, dtype=torch.float64)]
        self.proposals = 0

    def add(self, moves: Tensor) -> None:
        """Add the moves Δ (M, S) of M accepted edits."""
        moves = moves.double()
        self._total += moves.sum(dim=0)
        self._moments += moves.T @ moves
        self._lengths.append(moves.norm(dim=1))

    def report(self, rho_high: float, dimensions: int) -> MoveReport:
        """Summarise the moves; without any, ratio is NaN and rank 0. Lengths end at ρ_high."""
        lengths = torch.cat(self._lengths).numpy()
        counts, edges = np.histogram(lengths, bins=_BINS, range=(0.0, rho_high))
        levels = _QUANTILES if len(lengths) else ()
        ratio, rank = math.nan, 0.0
        if lengths.sum() > 0:
            ratio = float(self._total.norm()) / lengths.sum()
            spectrum = torch.linalg.eigvalsh(self._moments).clamp(min=0)
            share = spectrum / spectrum.sum()
            rank = float(torch.exp(-torch.special.xlogy(share, share).sum()))
        return MoveReport(
            edits=len(lengths),
            length_quantiles={f"{q:g}": float(np.quantile(lengths, q)) for q in levels},
            histogram_edges=tuple(edges.tolist()),
            histogram_counts=tuple(counts.tolist()),
            mean_move_ratio=ratio,
            effective_rank=rank,
            dimensions=dimensions,
        )


def _report(
    copies: int,
    proposals: int,
    moves: MoveReport,
    epsilon_r: float,
    crm_report: CRMReport,
) -> AugmentationReport:
    delta = crm_report.delta[_DELTA_LEVEL]
    bound = delta + epsilon_r
    deviations = bound / crm_report.reward_std
    change = f"{bound:.3g} ({deviations:.2g} standard deviations)"
    if proposals == 0:
        verdict = "no state is edited"
    elif moves.edits == 0:
        median = f"{crm_report.delta['0.5']:.3g}"
        verdict = f"no edit was accepted; the reward model's median held-out error is {median}"
    elif deviations >= 1:
        verdict = f"the bound means nothing: it allows a change of the reward by {change}"
    else:
        verdict = (
            f"an accepted edit changes the true reward by at most {change}, provided that the "
            "reward model is as accurate at edited states as on 95% of held-out steps"
        )
    warnings = [fit_warning(crm_report.r2_without_z), crm_report.warning]
    if moves.edits and moves.mean_move_ratio > 0.5:
        warnings.append(
            f"edit collapse: {moves.mean_move_ratio:.0%} of the average edit is one shift common "
            f"to all states (effective rank {moves.effective_rank:.1f} of {moves.dimensions})"
        )
    return AugmentationReport(
        copies=copies,
        proposals=proposals,
        acceptance=moves.edits / max(1, proposals),
        moves=moves,
        epsilon_r=epsilon_r,
        delta=delta,
        bound=bound,
        verdict=verdict,
        warnings=tuple(filter(None, warnings)),
        reward_model=crm_report,
    )


# Other actions.


@dataclass(frozen=True)
class ActionGenerator:
    """Proposes other actions at logged steps (s, a, r), with their counterfactual rewards.

    The disturbance z is abduced and kept; another action a' is that of a random training step whose
    state lies in the same cluster as s; its reward r' = f̂_r(s, a', z), within the range of the log,
    must differ from r by more than δ, and |f̂_r(s, a, z) − r| ≤ ε_r must hold.
    """

    view: EpisodeStore
    crm: CausalRewardModel
    clusters: StateClusters
    support: ActionSupport
    epsilon_r: float
    delta: float

    def propose(
        self,
        episodes: IntArray,
        steps: IntArray,
        count: int,
        seed: int,
    ) -> tuple[AugmentedEpisodes, ActionReport]:
        """Draw `count` other actions, with replacement, at each of M steps of episodes (M,), and
        copy what passes; a draw of the logged action itself is not a proposal."""
        # In float64, so that a later check confirms what passes.
        view, exact = self.view, copy.deepcopy(self.crm).double()
        rng = np.random.default_rng([seed, _ACTION_STREAM])

        @torch.no_grad()
        def predict(start: int) -> tuple[IntArray, Array, Array, BoolArray]:
            """Draw at some of the steps: their numbers, other actions, predicted rewards, and
            whether the model reproduces the logged reward."""
            drawn_at = np.arange(start, min(start + _ACTION_CHUNK, len(steps)))
            at = episodes[drawn_at], steps[drawn_at]
            factual = view.transitions(at[0], at[1]).to(self.crm.device)
            s, a, r = (v.double() for v in (factual.states, factual.actions, factual.rewards))
            z = exact.abduct(s, a, r)
            error = (exact.predict(s, a, z) - r).abs()
            reproduced = (error <= self.epsilon_r).cpu().numpy()
            labels = self.clusters.nearest(self.crm.normalise_states(factual.states).cpu()).numpy()
            rows = np.repeat(np.arange(len(drawn_at)), count)
            actions, drawable = self.support.draw(labels[rows], rng)
            logged = read_actions(view, at[0][rows], at[1][rows])
            differs = drawable & np.atleast_2d((actions != logged).T).any(axis=0)
            rows, actions = rows[differs], actions[differs]
            changed = view.action_vectors(torch.from_numpy(actions))
            predicted = exact.predict(s[rows], changed.to(s), z[rows]).cpu().numpy()
            return drawn_at[rows], actions, predicted, reproduced[rows]

        chunks = map(predict, range(0, max(1, len(steps)), _ACTION_CHUNK))
        rows, actions, predicted, reproduced = map(np.concatenate, zip(*chunks, strict=True))
        logged_rewards = view.column(schema.REWARD)
        reward = predicted.clip(logged_rewards.min(), logged_rewards.max()).astype(np.float32)
        logged = view.step_values(schema.REWARD, episodes[rows], steps[rows])
        change = reward - logged.astype(np.float64)
        accepted = reproduced & (np.abs(change) > self.delta)
        change, copied = change[accepted], rows[accepted]
        report = ActionReport(
            proposals=len(rows),
            reproduced=float(reproduced.mean()) if len(rows) else 0.0,
            copies=len(change),
            mean_change=float(change.mean()) if len(change) else 0.0,
            earns_more=float((change > 0).mean()) if len(change) else 0.0,
        )
        copies = AugmentedEpisodes(
            edit_state=np.zeros((0, view.state_size), np.float32),
            action_source=view.episode_ids[episodes[copied]],
            action_step=steps[copied],
            action=actions[accepted],
            action_reward=reward[accepted],
        )
        return copies, report


def read_actions(view: EpisodeStore, episodes: IntArray, steps: IntArray) -> Array:
    """The logged actions of M steps, (M,) int64 items or (M, A) float32 vectors."""
    if view.has_items:
        return view.items_at(episodes, steps)
    return view.step_values(schema.ACTION, episodes, steps)
