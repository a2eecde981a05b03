"""Action copies: the reward of another action, and which answers the gate lets pass."""

import copy
import functools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.planted import f, planted, planted_store
from ucfrec import schema
from ucfrec.counterfactual.action_augmentation import ActionGenerator, ActionReport, logged_actions
from ucfrec.counterfactual.clusters import ActionSupport
from ucfrec.counterfactual.generators import CSGConfig, state_clusters
from ucfrec.counterfactual.reward_model import CausalRewardModel, CRMConfig
from ucfrec.counterfactual.reward_model_fit import CRMReport, fit_crm
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Overlay


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@functools.cache
def view() -> EpisodeStore:
    return planted_store().split("train")


@functools.cache
def fitted() -> tuple[CausalRewardModel, CRMReport]:
    """A reward model that is fitted in seconds."""
    torch.set_num_threads(1)
    train, held_out = planted(8_000, 0).transitions, planted(2_000, 1).transitions
    return fit_crm(
        train, held_out, CRMConfig(hidden=64, epochs=6), Path(tempfile.mkdtemp()), seed=0
    )


@functools.cache
def others() -> ActionGenerator:
    """Asks at the steps of the planted store, with the gate of the default settings."""
    crm, report = fitted()
    steps = view().all_steps()
    training = view().transitions(*steps)
    clusters = state_clusters(training, crm, CSGConfig(), 0)
    labels = clusters.nearest(crm.normalised_states(training.states)).numpy()
    support = ActionSupport(labels, logged_actions(view(), *steps))
    epsilon_r, delta = 0.1 * float(crm.reward_std), report.delta["0.95"]
    read = EpisodeStore.transitions
    return ActionGenerator(view(), crm, clusters, support, epsilon_r, delta, read)


def asked(how: ActionGenerator, count: int = 3, seed: int = 0) -> tuple[Overlay, ActionReport]:
    return how.propose(*view().all_steps(), count, seed)


def sources(overlay: Overlay) -> tuple[Tensor, Tensor, Tensor]:
    """Logged states, actions and rewards of the steps that were changed, in float64."""
    logged = planted_store().transitions(overlay.action_source, overlay.action_step)
    return logged.states.double(), logged.actions.double(), logged.rewards.double()


def test_the_other_reward_is_the_models_with_the_disturbance_kept() -> None:
    exact = copy.deepcopy(fitted()[0]).double()
    overlay, report = asked(others())
    assert report.copies == len(overlay.action_source) > 1_000
    s, a, r = sources(overlay)
    rewards = view().step_values(schema.REWARD, *view().all_steps())
    with torch.no_grad():
        z = exact.abduct(s, a, r)
        factual = exact.predict(s, a, z)
        other = exact.predict(s, torch.from_numpy(overlay.action).double(), z)
    other = other.clamp(float(rewards.min()), float(rewards.max()))
    np.testing.assert_allclose(overlay.action_reward, other, rtol=1e-6, atol=1e-6)
    assert (factual - r).abs().max() <= others().epsilon_r
    change = overlay.action_reward - r.numpy()
    assert np.abs(change).min() > others().delta
    assert report.mean_change == pytest.approx(change.mean())
    assert report.earns_more == pytest.approx((change > 0).mean())


def test_the_other_reward_is_near_the_true_one() -> None:
    overlay, _ = asked(others())
    s, a, _ = sources(overlay)
    truth = f(s, torch.from_numpy(overlay.action).double()) - f(s, a)
    made = view().with_overlay(overlay)
    change = torch.from_numpy(made._reward_changes)
    assert torch.corrcoef(torch.stack([truth, change]))[0, 1] > 0.9


def test_only_other_actions_of_the_same_cluster_are_asked_about() -> None:
    overlay, _ = asked(replace(others(), epsilon_r=np.inf, delta=0.0))
    crm, clusters = fitted()[0], others().clusters
    logged = view().transitions(*view().all_steps())
    near = clusters.nearest(crm.normalised_states(logged.states)).tolist()
    cluster_of = {
        action.tobytes(): n for action, n in zip(logged.actions.numpy(), near, strict=True)
    }
    at = planted_store().transitions(overlay.action_source, overlay.action_step)
    own = clusters.nearest(crm.normalised_states(at.states)).tolist()
    assert [cluster_of[action.tobytes()] for action in overlay.action] == own
    assert (overlay.action != at.actions.numpy()).any(axis=1).all()
    assert set(overlay.action_source) <= set(view().episode_ids)


def test_the_gate_opens_and_shuts() -> None:
    steps = view().n_steps
    _, open_ = asked(replace(others(), epsilon_r=np.inf, delta=0.0))
    # A draw of the logged action is not a proposal; in large clusters that is rare.
    assert 2.9 * steps < open_.proposals <= 3 * steps
    assert open_.copies == open_.proposals
    assert open_.reproduced == 1
    for closed in (replace(others(), epsilon_r=1e-12), replace(others(), delta=1e9)):
        overlay, report = asked(closed)
        assert (len(overlay.action_source), report.copies) == (0, 0)
        assert (report.mean_change, report.earns_more) == (0, 0)
        assert report.proposals == open_.proposals
        assert len(view().with_overlay(overlay)) == len(view())


def test_draws_are_the_seeds() -> None:
    first, again, other = (asked(others(), 1, seed)[0] for seed in (0, 0, 1))
    assert np.array_equal(first.action_reward, again.action_reward)
    assert not np.array_equal(first.action_reward[:50], other.action_reward[:50])


def test_no_reward_leaves_the_range_of_the_log() -> None:
    rewards = view().step_values(schema.REWARD, *view().all_steps())
    exaggerating = copy.deepcopy(fitted()[0])
    exaggerating.reward_std *= 3
    how = replace(others(), crm=exaggerating, epsilon_r=np.inf)
    made = asked(how)[0].action_reward
    assert (made.min(), made.max()) == (rewards.min(), rewards.max())


def test_no_steps_make_no_copies() -> None:
    nothing = np.zeros(0, dtype=np.int64)
    overlay, report = others().propose(nothing, nothing, 2, 0)
    assert (report.proposals, len(overlay.action_source)) == (0, 0)
