"""Every edit passes both gates; other actions get the reward of the model with z kept."""

import functools
import json
import math
import tempfile
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.support.planted import ACTION, CONSTANT, STATE, STEPS, f, fitted, planted, planted_store
from ucfrec import schema
from ucfrec.arrays import Float32Array
from ucfrec.counterfactual.augmentation import (
    ActionGenerator,
    ActionReport,
    AugmentationReport,
    AugmentConfig,
    MoveStatistics,
    accept,
    augment_episodes,
    edit_states,
    read_actions,
)
from ucfrec.counterfactual.generators import (
    ActionSupport,
    CSGConfig,
    Generator,
    make_generator,
    state_clusters,
)
from ucfrec.counterfactual.reward_model import CausalRewardModel, CRMConfig
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes, Transitions

ALGORITHM_5 = AugmentConfig(copies=4, edits_per_copy=1, reward_quantile=0.0)
APPENDIX_H = AugmentConfig(copies=2, edits_per_copy=0, reward_quantile=0.3)
QUICK = CRMConfig(epochs=2, hidden=32)
BOTH = pytest.mark.parametrize("config", [ALGORITHM_5, APPENDIX_H], ids=["algorithm 5", "H"])


@functools.cache
def view() -> EpisodeStore:
    return planted_store().split("train")


def logged_rewards() -> Float32Array:
    return view().step_values(schema.REWARD, *view().all_steps())


@functools.cache
def generator() -> Generator:
    steps = planted(20_000, 0).transitions
    return make_generator(steps, fitted()[0], CSGConfig(), Path(tempfile.mkdtemp()), seed=0)


def augmented(
    config: AugmentConfig, seed: int = 0, by: Generator | None = None
) -> tuple[AugmentedEpisodes, AugmentationReport]:
    return edit_states(view(), *fitted(), by or generator(), config, seed)


@BOTH
def test_every_edit_passes_both_gates_in_float64(config: AugmentConfig) -> None:
    crm = deepcopy(fitted()[0]).double()
    copies, report = augmented(config)
    base = planted_store().transitions(copies.copy_source[copies.edit_copy], copies.edit_step)
    s, a, r = base.states.double(), base.actions.double(), base.rewards.double()
    edited = torch.from_numpy(copies.edit_state).double()
    with torch.no_grad():
        change = (crm.predict(edited, a, crm.abduct(s, a, r)) - r).abs()
    sigma = crm.state_std.double()
    varies = sigma > 0
    length = ((edited - s)[:, varies] / sigma[varies]).norm(dim=1)
    assert change.max() <= report.epsilon_r
    assert length.max() <= 0.5
    assert torch.equal(edited[:, CONSTANT], s[:, CONSTANT])
    assert report.acceptance >= 0.8


def test_appendix_h_carries_every_accepted_edit_above_the_quantile() -> None:
    copies, report = augmented(APPENDIX_H)
    least = np.quantile(logged_rewards(), 0.3)
    assert report.proposals == 2 * (logged_rewards() >= least).sum()
    accepted = round(report.acceptance * report.proposals)
    assert len(copies.edit_step) == report.moves.edits == accepted
    sources = copies.copy_source[copies.edit_copy]
    assert planted_store().step_values(schema.REWARD, sources, copies.edit_step).min() >= least
    # Copies of one episode are edited apart from one another.
    assert len(np.unique(copies.edit_state, axis=0)) == len(copies.edit_state)


class EvenSteps:
    """Leaves states alone where the first is ≥ 0, and moves too far elsewhere."""

    band = (0.2, 0.5)

    def propose(self, at: Transitions, z: Tensor, generator: torch.Generator) -> Tensor:
        return torch.where(at.states[:, :1] >= 0, at.states, at.states + 10.0)


@pytest.mark.parametrize("edits", [1, 3])
def test_algorithm_5_fills_copies_and_stops(edits: int) -> None:
    config = replace(ALGORITHM_5, edits_per_copy=edits)
    copies, report = augmented(config, by=EvenSteps())
    per_copy = np.bincount(copies.edit_copy)
    assert per_copy.max() == edits
    episodes, steps = view().all_steps()
    passing = view().transitions(episodes, steps).states[:, 0].numpy() >= 0
    most = np.minimum(np.bincount(episodes[passing], minlength=len(view())), 4 * edits)
    made = np.bincount(copies.copy_source, weights=per_copy, minlength=len(view())).astype(int)
    # The stub's proposals change no reward, so only the reward model's own error rejects.
    assert (made <= most).all()
    assert made.sum() >= 0.95 * most.sum()
    assert report.proposals < len(steps)
    pairs = np.stack([copies.copy_source[copies.edit_copy], copies.edit_step])
    assert len(np.unique(pairs, axis=1).T) == len(copies.edit_step)


@BOTH
def test_edits_are_in_order_and_the_seeds(config: AugmentConfig) -> None:
    copies, _ = augmented(config)
    key = copies.edit_copy * (STEPS + 1) + copies.edit_step
    assert (np.diff(key) > 0).all()
    assert np.array_equal(np.unique(copies.edit_copy), np.arange(len(copies.copy_source)))
    assert copies.edit_state.dtype == np.float32
    again, other = augmented(config)[0], augmented(config, seed=1)[0]
    assert np.array_equal(copies.edit_state, again.edit_state)
    assert not np.array_equal(copies.edit_state[:10], other.edit_state[:10])
    sampled, report = augmented(replace(config, max_steps=500))
    assert 0 < report.proposals <= 500 * config.copies
    assert len(np.unique(sampled.copy_source)) < len(view())


def test_the_report_says_what_proposition_1_promises() -> None:
    crm, crm_report = fitted()
    copies, report = augmented(APPENDIX_H)
    assert report.epsilon_r == pytest.approx(0.1 * float(crm.reward_std))
    assert report.bound == report.delta + report.epsilon_r
    assert report.verdict.startswith("an accepted edit changes the true reward by at most")
    assert report.warnings == ()
    assert sum(report.moves.histogram_counts) == report.moves.edits == len(copies.edit_step)
    assert json.loads(json.dumps(asdict(report)))["reward_model"]["latent_dim"] == 16
    poor = replace(crm_report, delta=dict.fromkeys(crm_report.delta, 5.0))
    _, doubted = edit_states(view(), crm, poor, generator(), ALGORITHM_5, 0)
    assert doubted.verdict.startswith("the bound means nothing")
    _, strict = augmented(replace(APPENDIX_H, epsilon_r=1e-12))
    assert strict.verdict.startswith("no edit was accepted")
    assert (strict.copies, strict.acceptance) == (0, 0.0)


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.floats(0, 2), min_size=1, max_size=8),
    epsilon_r=st.floats(0, 3),
    rho_high=st.floats(0, 2),
    seed=st.integers(0, 2**31),
)
def test_the_gate_is_equation_4(
    lengths: list[float], epsilon_r: float, rho_high: float, seed: int
) -> None:
    torch.manual_seed(seed)
    size = len(lengths)
    crm = CausalRewardModel(STATE, ACTION, CRMConfig(hidden=8, latent_dim=2)).double()
    crm.state_std.copy_(torch.rand(STATE) + 0.1)
    crm.state_std[CONSTANT] = 0.0
    s, a, r = (torch.randn(size, n).double() for n in (STATE, ACTION, 1))
    r, direction = r[:, 0], torch.randn(size, STATE).double() * (crm.state_std > 0)
    direction = direction / direction.norm(dim=1, keepdim=True)
    edited = s + crm.state_std * direction * torch.tensor(lengths).double().unsqueeze(1)
    factual = Transitions(s, a, r, torch.zeros_like(s), torch.zeros(size, dtype=torch.bool))
    with torch.no_grad():
        z = crm.abduct(s, a, r)
        got = accept(crm, factual, z, edited, epsilon_r, rho_high)
        for i in range(size):
            change = abs(float(crm.predict(edited[i], a[i], z[i])) - float(r[i]))
            if min(abs(change - epsilon_r), abs(lengths[i] - rho_high)) > 1e-6:
                assert bool(got[i]) == (change <= epsilon_r and lengths[i] <= rho_high)
        moved = edited + torch.eye(STATE)[CONSTANT]
        assert not accept(crm, factual, z, moved, math.inf, 1e9).any()


def test_constant_moves_are_collapsed_and_isotropic_ones_are_not() -> None:
    varied = torch.randn(4_000, 5, generator=torch.Generator().manual_seed(0))
    constant = torch.tensor([[0.1, 0.2, 0.0, 0.0, 0.3]]).repeat(500, 1)
    for moves, ratio, rank in ((constant, 1, 1), (varied, 0, 5), (varied[:0], math.nan, 0)):
        statistics = MoveStatistics(5)
        for chunk in torch.split(moves, 100):
            statistics.add(chunk)
        found = statistics.report(rho_high=10.0, dimensions=5)
        assert found.mean_move_ratio == pytest.approx(ratio, abs=0.05, nan_ok=True)
        assert (found.edits, found.effective_rank) == (len(moves), pytest.approx(rank, abs=0.05))


# Other actions.


@functools.cache
def others() -> ActionGenerator:
    """Asks at the steps of the planted store, with the gate of the default settings."""
    crm, report = fitted()
    steps = view().all_steps()
    training = view().transitions(*steps)
    clusters = state_clusters(training, crm, CSGConfig(), 0)
    labels = clusters.nearest(crm.normalise_states(training.states)).numpy()
    support = ActionSupport(labels, read_actions(view(), *steps))
    epsilon_r, delta = 0.1 * float(crm.reward_std), report.delta["0.95"]
    return ActionGenerator(view(), crm, clusters, support, epsilon_r, delta)


def asked(
    how: ActionGenerator, count: int = 3, seed: int = 0
) -> tuple[AugmentedEpisodes, ActionReport]:
    return how.propose(*view().all_steps(), count, seed)


def test_the_other_reward_is_the_models_with_the_disturbance_kept() -> None:
    exact = deepcopy(fitted()[0]).double()
    copies, report = asked(others())
    assert report.copies == len(copies.action_source) > 1_000
    logged = planted_store().transitions(copies.action_source, copies.action_step)
    s, a, r = logged.states.double(), logged.actions.double(), logged.rewards.double()
    rewards = logged_rewards()
    with torch.no_grad():
        z = exact.abduct(s, a, r)
        factual = exact.predict(s, a, z)
        other = exact.predict(s, torch.from_numpy(copies.action).double(), z)
    other = other.clamp(float(rewards.min()), float(rewards.max()))
    np.testing.assert_allclose(copies.action_reward, other, rtol=1e-6, atol=1e-6)
    assert (factual - r).abs().max() <= others().epsilon_r
    change = copies.action_reward - r.numpy()
    assert np.abs(change).min() > others().delta
    assert report.mean_change == pytest.approx(change.mean())
    assert report.earns_more == pytest.approx((change > 0).mean())
    # The change is near the true one.
    truth = f(s, torch.from_numpy(copies.action).double()) - f(s, a)
    assert np.corrcoef(truth, change)[0, 1] > 0.9


def test_the_gate_opens_and_shuts() -> None:
    steps = view().n_steps
    made, open_ = asked(replace(others(), epsilon_r=np.inf, delta=0.0))
    logged = planted_store().transitions(made.action_source, made.action_step).actions.numpy()
    assert (made.action != logged).any(axis=1).all()
    assert set(made.action_source) <= set(view().episode_ids)
    # A draw of the logged action is not a proposal; in large clusters that is rare.
    assert 2.9 * steps < open_.proposals <= 3 * steps
    assert open_.copies == open_.proposals
    assert open_.reproduced == 1
    for closed in (replace(others(), epsilon_r=1e-12), replace(others(), delta=1e9)):
        copies, report = asked(closed)
        assert (len(copies.action_source), report.copies) == (0, 0)
        assert (report.mean_change, report.earns_more) == (0, 0)
        assert report.proposals == open_.proposals


def test_draws_are_the_seeds_and_no_reward_leaves_the_range_of_the_log() -> None:
    first, again, other = (asked(others(), 1, seed)[0].action_reward for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first[:50], other[:50])
    nothing = np.zeros(0, dtype=np.int64)
    copies, report = others().propose(nothing, nothing, 2, 0)
    assert (report.proposals, len(copies.action_source)) == (0, 0)
    exaggerating = deepcopy(fitted()[0])
    exaggerating.reward_std *= 3
    made = asked(replace(others(), crm=exaggerating, epsilon_r=np.inf))[0].action_reward
    assert (made.min(), made.max()) == (logged_rewards().min(), logged_rewards().max())


# From views of the log to copies of both kinds.


def made_from_views(
    csg: CSGConfig, config: AugmentConfig, folder: Path
) -> tuple[AugmentedEpisodes, AugmentationReport]:
    views = planted_store().split("train"), planted_store().split("validation")
    return augment_episodes(*views, QUICK, csg, config, folder, seed=0)


def test_asking_about_actions_leaves_the_edits_as_they_are(tmp_path: Path) -> None:
    csg = CSGConfig(kind="faithful", epochs=2, hidden=32)
    loose = AugmentConfig(copies=2, epsilon_r=3.0)
    without, report = made_from_views(csg, loose, tmp_path / "without")
    with_, _ = made_from_views(csg, replace(loose, actions=2), tmp_path / "with")
    for name in ("copy_source", "edit_copy", "edit_step", "edit_state"):
        assert np.array_equal(getattr(without, name), getattr(with_, name))
    assert len(without.edit_step) > len(without.action_source) == 0
    assert len(with_.action_source) > 0
    assert report.reward_model.validation_transitions == planted_store().split("validation").n_steps
    assert any(warning.startswith("edit collapse") for warning in report.warnings)


def test_actions_alone_need_no_generator(tmp_path: Path) -> None:
    config = AugmentConfig(copies=0, actions=1, epsilon_r=3.0, reward_quantile=0.5)
    copies, report = made_from_views(CSGConfig(kind="faithful"), config, tmp_path)
    assert not (tmp_path / "csg").exists()
    assert (len(copies.copy_source), report.copies, report.proposals) == (0, 0, 0)
    assert report.verdict == "no state is edited"
    assert report.actions is not None
    assert report.actions.copies == len(copies.action_source) > 0
    logged = planted_store().step_values(schema.REWARD, copies.action_source, copies.action_step)
    assert logged.min() >= np.quantile(logged_rewards(), 0.5)
