"""Every edit in an overlay passes both gates; copies differ from their source in nothing else."""

import copy
import functools
import json
import math
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.support.planted import ACTION, CONSTANT, STATE, STEPS, fitted, planted
from tests.support.planted import planted_store as store
from ucfrec import schema
from ucfrec.counterfactual.generators import CSGConfig, Generator, make_generator
from ucfrec.counterfactual.reward_model import CausalRewardModel, CRMConfig
from ucfrec.counterfactual.state_augmentation import (
    AugmentationReport,
    AugmentConfig,
    MoveStatistics,
    accept,
    augment,
)
from ucfrec.episodes.windows import Overlay, Transitions
from ucfrec.errors import InputError

ALGORITHM_5 = AugmentConfig(copies=4, edits_per_copy=1, reward_quantile=0.0)
APPENDIX_H = AugmentConfig(copies=2, edits_per_copy=0, reward_quantile=0.3)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@functools.cache
def generator() -> Generator:
    return make_generator(
        planted(20_000, 0).transitions, fitted()[0], CSGConfig(), Path(tempfile.mkdtemp()), seed=0
    )


def augmented(
    config: AugmentConfig, seed: int = 0, by: Generator | None = None
) -> tuple[Overlay, AugmentationReport]:
    return augment(store().split("train"), *fitted(), by or generator(), config, seed)


@pytest.mark.parametrize("config", [ALGORITHM_5, APPENDIX_H], ids=["algorithm 5", "appendix H"])
def test_every_edit_passes_both_gates_in_float64(config: AugmentConfig) -> None:
    crm = copy.deepcopy(fitted()[0]).double()
    overlay, report = augmented(config)
    base = store().transitions(overlay.copy_source[overlay.edit_copy], overlay.edit_step)
    s, a, r = base.states.double(), base.actions.double(), base.rewards.double()
    edited = torch.from_numpy(overlay.edit_state).double()
    with torch.no_grad():
        change = (crm.predict(edited, a, crm.abduct(s, a, r)) - r).abs()
    sigma = crm.state_std.double()
    varies = sigma > 0
    length = ((edited - s)[:, varies] / sigma[varies]).norm(dim=1)
    assert change.max() <= report.epsilon_r
    assert length.max() <= 0.5
    assert torch.equal(edited[:, CONSTANT], s[:, CONSTANT])
    assert report.acceptance >= 0.8


def test_copies_differ_in_edited_states_only() -> None:
    view = store().split("train")
    overlay, _ = augmented(APPENDIX_H)
    union = view.with_overlay(overlay)
    assert len(union) == len(view) + len(overlay.copy_source)
    copies, steps = union.all_steps()
    copies, steps = copies[copies >= len(view)], steps[copies >= len(view)]
    made, base = (
        union.transitions(copies, steps),
        store().transitions(overlay.copy_source[copies - len(view)], steps),
    )
    for name in ("actions", "rewards", "next_states", "last"):
        assert torch.equal(getattr(made, name), getattr(base, name))
    kept = union.step_values(schema.RETURN_TO_GO, copies, steps)
    source = overlay.copy_source[copies - len(view)]
    assert np.array_equal(kept, store().step_values(schema.RETURN_TO_GO, source, steps))
    differs = (made.states != base.states).any(dim=1).numpy()
    assert differs.sum() == len(overlay.edit_step)


def test_appendix_h_carries_every_accepted_edit_above_the_quantile() -> None:
    view = store().split("train")
    overlay, report = augmented(APPENDIX_H)
    rewards = view.step_values(schema.REWARD, *view.all_steps())
    high = rewards >= np.quantile(rewards, 0.3)
    assert report.proposals == 2 * high.sum()
    assert (
        len(overlay.edit_step) == report.moves.edits == round(report.acceptance * report.proposals)
    )
    edited = store().step_values(
        schema.REWARD, overlay.copy_source[overlay.edit_copy], overlay.edit_step
    )
    assert edited.min() >= np.quantile(rewards, 0.3)
    # Copies of one episode are edited apart from one another.
    assert len(np.unique(overlay.edit_state, axis=0)) == len(overlay.edit_state)


class EvenSteps:
    """Leaves states alone where the first is ≥ 0, and moves too far elsewhere."""

    band = (0.2, 0.5)

    def propose(
        self, states: Tensor, actions: Tensor, z: Tensor, generator: torch.Generator
    ) -> Tensor:
        return torch.where(states[:, :1] >= 0, states, states + 10.0)


@pytest.mark.parametrize("edits", [1, 3])
def test_algorithm_5_fills_copies_and_stops(edits: int) -> None:
    view = store().split("train")
    config = replace(ALGORITHM_5, edits_per_copy=edits)
    overlay, report = augmented(config, by=EvenSteps())
    per_copy = np.bincount(overlay.edit_copy)
    assert per_copy.max() == edits
    episodes, steps = view.all_steps()
    acceptable = np.bincount(
        episodes, weights=view.transitions(episodes, steps).states[:, 0].numpy() >= 0
    ).astype(int)
    made = np.bincount(overlay.copy_source, weights=per_copy, minlength=len(view)).astype(int)
    # The stub's proposals change no reward, so only the reward model's own error rejects.
    assert (made <= np.minimum(acceptable, 4 * edits)).all()
    assert made.sum() >= 0.95 * np.minimum(acceptable, 4 * edits).sum()
    assert report.proposals < len(steps)
    source = overlay.copy_source[overlay.edit_copy]
    pairs = np.stack([source, overlay.edit_step])
    assert len(np.unique(pairs, axis=1).T) == len(overlay.edit_step)


@pytest.mark.parametrize("config", [ALGORITHM_5, APPENDIX_H], ids=["algorithm 5", "appendix H"])
def test_overlays_are_in_order_and_the_seeds(config: AugmentConfig) -> None:
    overlay, _ = augmented(config)
    key = overlay.edit_copy * (STEPS + 1) + overlay.edit_step
    assert (np.diff(key) > 0).all()
    assert np.array_equal(np.unique(overlay.edit_copy), np.arange(len(overlay.copy_source)))
    assert overlay.edit_state.dtype == np.float32
    again, other = augmented(config)[0], augmented(config, seed=1)[0]
    assert np.array_equal(overlay.edit_state, again.edit_state)
    assert not np.array_equal(overlay.edit_state[:10], other.edit_state[:10])


def test_a_large_store_is_sampled() -> None:
    overlay, report = augmented(replace(APPENDIX_H, copies=1, max_steps=500))
    assert 0 < report.proposals <= 500
    assert len(overlay.copy_source) < len(store().split("train"))


def test_the_report_says_what_proposition_1_promises() -> None:
    crm, crm_report = fitted()
    overlay, report = augmented(APPENDIX_H)
    assert report.epsilon_r == pytest.approx(0.1 * float(crm.reward_std))
    assert report.bound == report.delta + report.epsilon_r
    assert report.verdict.startswith("an accepted edit changes the true reward by at most")
    assert report.warnings == ()
    assert sum(report.moves.histogram_counts) == report.moves.edits == len(overlay.edit_step)
    assert json.loads(json.dumps(asdict(report)))["reward_model"]["latent_dim"] == 16

    poor = replace(crm_report, delta=dict.fromkeys(crm_report.delta, 5.0))
    _, doubted = augment(store().split("train"), crm, poor, generator(), ALGORITHM_5, 0)
    assert doubted.verdict.startswith("the bound means nothing")
    _, strict = augmented(replace(APPENDIX_H, epsilon_r=1e-12))
    assert strict.verdict.startswith("no edit was accepted")
    assert (strict.copies, strict.acceptance) == (0, 0.0)


def test_impossible_configurations_are_refused() -> None:
    for wrong in (
        {"copies": -1},
        {"actions": -1},
        {"edits_per_copy": -1},
        {"reward_quantile": 1.0},
    ):
        with pytest.raises(InputError, match="augment"):
            augmented(replace(APPENDIX_H, **wrong))


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
    s, a, r = torch.randn(size, STATE), torch.randn(size, ACTION), torch.randn(size)
    s, a, r = s.double(), a.double(), r.double()
    direction = torch.randn(size, STATE).double() * (crm.state_std > 0)
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
    def report(moves: Tensor) -> tuple[float, float]:
        statistics = MoveStatistics(5)
        for chunk in torch.split(moves, 100):
            statistics.add(chunk)
        found = statistics.report(rho_high=10.0, dimensions=5)
        return found.mean_move_ratio, found.effective_rank

    assert report(torch.tensor([[0.1, 0.2, 0.0, 0.0, 0.3]]).repeat(500, 1)) == pytest.approx((1, 1))
    ratio, rank = report(torch.randn(4_000, 5, generator=torch.Generator().manual_seed(0)))
    assert ratio < 0.05
    assert rank == pytest.approx(5, abs=0.05)
    nothing = MoveStatistics(5).report(0.5, 5)
    assert (nothing.edits, nothing.effective_rank) == (0, 0.0)
    assert math.isnan(nothing.mean_move_ratio)
