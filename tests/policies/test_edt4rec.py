"""The baselines: invariants they share, what distinguishes each, and that it matters."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.policies.test_ucf import CATALOG, both_heads, build, changed_at, random_windows, trained
from tests.support.episodes import random_episodes, some_states, write_store
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.edt4rec import ConservativeQ, _consistent, optimistic_returns, relabel
from ucfrec.policies.registry import policy_class
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy


def gradients(policy: SequencePolicy, windows: Windows, part: str) -> Tensor:
    """Of the loss, with respect to the parameters whose name begins with `part`."""
    policy.zero_grad()
    torch.manual_seed(3)
    policy.loss(windows)[0].backward()
    named = [p for name, p in policy.named_parameters() if name.startswith(part)]
    return torch.cat([torch.zeros(1) if p.grad is None else p.grad.ravel() for p in named])


@both_heads
@pytest.mark.parametrize(
    ("name", "extra", "part"),
    [("cdt4rec", "reward", "estimate"), ("dt4rec", "contrastive", "embed.embed_return")],
)
def test_without_its_own_part_loss_and_gradient_differ(
    name: str, extra: str, part: str, sizes: dict[str, int]
) -> None:
    windows, weight = random_windows(sizes), f"{extra}_weight"
    policy, without = build(name, sizes), build(name, sizes, **{weight: 0.0})
    on, off = gradients(policy, windows, part), gradients(without, windows, part)
    assert on.abs().max() > 1e-6
    assert not torch.allclose(on, off)
    torch.manual_seed(3)
    loss, scalars = policy.loss(windows)
    torch.manual_seed(3)
    plain, _ = without.loss(windows)
    own = getattr(policy.config, weight) * scalars[f"{extra}_loss"]
    torch.testing.assert_close(loss - plain, own)


@both_heads
def test_the_reward_estimator_learns_the_reward_of_the_action_taken(sizes: dict[str, int]) -> None:
    policy, windows = build("cdt4rec", sizes, dropout=0.0), random_windows(sizes)
    first = policy.loss(windows)[1]["reward_loss"]
    trained(policy, windows, 150)
    assert policy.loss(windows)[1]["reward_loss"] < 0.1 * first
    later = changed_at(windows, (slice(None), 6), ("actions",))
    estimate, moved = (
        policy.estimate_rewards(policy.attend(policy.tokens(w), w.mask), w.mask)
        for w in map(policy.normalize, (windows, later))
    )
    torch.testing.assert_close(moved[:, :6], estimate[:, :6])
    assert not torch.allclose(moved[:, 6], estimate[:, 6])


@pytest.mark.slow
@both_heads
def test_the_contrast_teaches_to_answer_what_was_asked(sizes: dict[str, int]) -> None:
    windows = random_windows(sizes)

    def contrast(weight: float) -> float:
        settings = {"dropout": 0.0, "recurrent_dropout": 0.0, "layers": 1}
        policy = build("dt4rec", sizes, contrastive_weight=weight, **settings)
        trained(policy, windows, 60)
        torch.manual_seed(0)
        given = policy.normalize(windows)
        encoded, features = policy.tokens(given)[1:], policy.features(given)
        return policy.contrastive_loss(given, encoded, features).item()

    assert contrast(10.0) < 0.85 * contrast(0.0)


@pytest.mark.slow
@both_heads
def test_the_entropy_constraint_holds_and_its_multiplier_follows(sizes: dict[str, int]) -> None:
    windows, entropies = random_windows(sizes), {}
    for beta in (-1e3, 0.9):
        settings = {"vector_entropy": beta, "item_entropy": beta, "layers": 1}
        policy = build("edt4rec", sizes, dropout=0.0, multiplier=1.0, **settings)
        before = policy.log_multiplier.item()
        trained(policy, windows, 250)
        features = policy.features(policy.normalize(_consistent(windows)))[windows.mask]
        entropies[beta] = policy.head.entropy(features).item()
        if beta < 0:
            assert policy.log_multiplier.item() < before
        else:
            assert entropies[beta] > 0.8 * policy.least_entropy
    assert entropies[-1e3] < entropies[0.9] - 0.5


def test_relabelled_windows_are_as_when_acting() -> None:
    windows = _consistent(random_windows(CATALOG))
    fall = windows.returns_to_go[:, :-1] - windows.returns_to_go[:, 1:]
    there = windows.mask[:, :-1]
    torch.testing.assert_close(fall[there], windows.rewards[:, :-1][there])
    assert (windows.returns_to_go[~windows.mask] == 0).all()


@given(st.lists(st.integers(1, 9), min_size=1, max_size=8), st.integers(0, 999))
def test_optimistic_returns_are_those_of_the_recursion(lengths: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    rewards, values = rng.normal(size=sum(lengths)), 3 * rng.normal(size=sum(lengths))
    expected = rewards.copy()
    ends = np.cumsum(lengths)
    for t in reversed(range(len(rewards) - 1)):
        if t + 1 not in ends:
            expected[t] += max(expected[t + 1], values[t + 1])
    found = optimistic_returns(rewards, values, np.array(lengths))
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("items", [True, False])
def test_relabelling_is_a_store_that_promises_no_less(tmp_path: Path, items: bool) -> None:
    episodes = random_episodes([5, 3, 7, 1, 4], items=items)
    store = write_store(tmp_path / "store", episodes, some_states() if items else None)
    view = store.select(np.array([0, 2, 4]))
    new, again = (relabel(view, 20, 1.0, tmp_path / "q", seed=0) for _ in range(2))
    assert new.n_episodes == 3
    before, after = (each.column("return_to_go") for each in (view, new))
    assert (after >= before - 1e-4).all()
    assert (after > before + 1e-3).any()
    np.testing.assert_array_equal(again.column("return_to_go"), after)


def test_cql_values_the_better_action_and_presses_unseen_ones_down(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    actions = np.where(rng.random((600, 1)) < 0.5, 0.5, -0.5)
    columns = {"action": actions, "reward": actions[:, 0] > 0}
    columns["observation"] = rng.normal(size=(600, 2))
    store = EpisodeStore.write(tmp_path / "store", columns, np.ones(600, dtype=np.int64))
    values = {}
    for weight in (0.0, 5.0):
        torch.manual_seed(0)
        network = ConservativeQ(store, weight)
        optimizer = torch.optim.Adam(network.network.parameters(), lr=5e-3)
        for _ in range(200):
            batch = store.transitions(*store.draw_steps(rng, 128))
            optimizer.zero_grad()
            network.loss(batch)[0].backward()
            optimizer.step()
        played = torch.tensor([[0.5], [-0.5], [0.0]])
        values[weight] = network.q(torch.zeros(1, 2), played[None])[0].detach()
    assert values[0.0][0] > values[0.0][1] + 0.5
    assert abs(values[0.0][0] - 1) < 0.2
    seen, unseen = values[5.0][:2].mean(), values[5.0][2]
    assert seen - unseen > values[0.0][:2].mean() - values[0.0][2] + 0.5


@pytest.mark.parametrize("name", ["bc", "edt4rec"])
def test_a_share_learns_from_the_best_sessions(name: str, tmp_path: Path) -> None:
    store = write_store(tmp_path / "store", random_episodes([4] * 20), some_states())
    policy_type = policy_class(name)
    own = {"cql_steps": 2} if name == "edt4rec" else {}

    def view(share: float) -> EpisodeStore:
        config = policy_type.Config(best_share=share, **own)
        return policy_type.training_view(store, config, tmp_path / str(share), 0)

    assert view(0.25).episode_ids.tolist() == sorted(np.argsort(-store.returns)[:5])
    assert view(1.0).n_episodes == 20
    with pytest.raises(InputError, match=r"policy\.best_share is 0"):
        view(0.0)


def test_buckets_and_reward_scale_come_from_the_training_data(tmp_path: Path) -> None:
    store = write_store(tmp_path / "store", random_episodes([6] * 9), some_states())
    prompted = new_policy(store, resolve_config("dt4rec"))
    returns = store.column("return_to_go") / float(prompted.return_scale)
    centres = prompted.embed.embed_return.centres
    assert (float(centres[0]), float(centres[-1])) == pytest.approx((returns.min(), returns.max()))
    estimating = new_policy(store, resolve_config("cdt4rec"))
    rewards = store.column("reward")
    assert float(estimating.reward_std) == pytest.approx(rewards.std(), rel=1e-5)
