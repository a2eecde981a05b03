"""Exposure, advantage weights and the largest return, in every policy; without them, nothing."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.policies.test_ucf import (
    CATALOG,
    ITEMS,
    VECTORS,
    K,
    changed_at,
    random_windows,
    sessions_of,
    trained,
)
from tests.policies.test_ucf import build as build_plain
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed
from ucfrec.errors import InputError
from ucfrec.fitting.loop import RowAdamW
from ucfrec.policies.base import BEST, SequencePolicy, ValueHead, advantage_weights
from ucfrec.policies.heads import ItemHead

TAGGED = {**CATALOG, "tags": 2}
POLICIES = ("ucf", "dt", "dc", "lsdt", "dt4rec", "cdt4rec", "edt4rec", "sasrec")
ADDITIONS = {"advantage_weights": True, "max_return": True}
policies = pytest.mark.parametrize("name", POLICIES)
kinds = pytest.mark.parametrize("sizes", [VECTORS, TAGGED], ids=["vectors", "items"])


def build(name: str, sizes: dict[str, int], **settings: Any) -> SequencePolicy:
    policy = build_plain(name, sizes, **{"dropout": 0.0, "exposure": False, **settings})
    if isinstance(policy.head, ItemHead) and policy.head.exposure is not None:
        tags = torch.randint(-1, 4, (ITEMS, 2))
        states = ItemStates(policy.head.embeddings, torch.zeros(0, 0), 0.0, 1.0, tags=tags)
        policy.head.exposure.start_from(states, torch.rand(99))
    return policy


@kinds
@policies
def test_every_learner_trains_and_acts_with_the_additions(name: str, sizes: dict[str, int]) -> None:
    more = {"exposure": True, "exposure_window": 3} if sizes["items"] else {}
    policy, windows = build(name, sizes, **ADDITIONS, **more), random_windows(sizes)
    policy.eval()
    before = policy.loss(windows)[1]
    trained(policy, windows, 25)
    assert policy.loss(windows)[1]["value_loss"] < before["value_loss"]
    assert torch.isfinite(policy.action_loss(windows))
    sessions = sessions_of(windows)
    for rule in (DecisionRule(None), DecisionRule(2.0)):
        assert torch.isfinite(Scorer(policy, rule).act(sessions)).all()
    if sizes["items"]:
        assert any(each.any() for each in policy.head.exposure.parameters()), "it learns too"


@pytest.mark.parametrize("name", [*POLICIES, "bc"])
def test_every_learner_learns_from_sampled_items(name: str) -> None:
    settings = {"sampled_above": ITEMS - 1, "sampled_items": 4, **ADDITIONS, "exposure": True}
    policy, windows = build(name, TAGGED, **settings), random_windows(TAGGED)
    before = policy.eval().action_loss(windows).detach()
    optimizer = RowAdamW(policy.parameters(), lr=1e-2)
    policy.train()
    for step in range(20):
        torch.manual_seed(step)
        optimizer.zero_grad()
        policy.loss(windows)[0].backward()  # type: ignore[no-untyped-call]
        assert policy.head.correction.grad.is_sparse
        optimizer.step()
    assert policy.eval().action_loss(windows) < before - 0.05


@policies
def test_exposure_moves_predictions_by_what_was_shown_alone(name: str) -> None:
    windows = random_windows(TAGGED)
    policy = trained(build(name, TAGGED, exposure=True, exposure_window=3), windows, 25)
    head, normalized = policy.head, policy.normalize(windows)
    for parameter in head.exposure.parameters():
        parameter.data += 0.1
    with torch.no_grad():
        plain = head.predict(policy.features(normalized)[:, -1])
        last = torch.arange(1, len(plain) + 1) * K - 1
        term = Exposed.before(normalized, 3, last)
        added = head.exposure.added_to(torch.zeros(len(last), ITEMS), term)
        torch.testing.assert_close(policy.act(windows), plain + added)


@kinds
def test_the_loss_is_weighted_by_the_advantage(sizes: dict[str, int]) -> None:
    policy, windows = build("dt", sizes, **ADDITIONS).eval(), random_windows(sizes)
    normalized = policy.normalize(windows)
    mask = windows.mask
    values = policy.values(normalized, policy.head.embed(windows.actions))[mask]
    returns = normalized.returns_to_go[mask]
    weights = advantage_weights(values, returns)
    assert weights.max() > 1.2 * weights.min()
    losses = policy.head.losses(policy.features(normalized)[mask], windows.actions[mask])
    expected = (weights * losses).sum() / mask.sum()
    value_loss = policy.values.loss(values, returns)
    loss, scalars = policy.loss(windows)
    torch.testing.assert_close(scalars["action_loss"], expected)
    torch.testing.assert_close(scalars["value_loss"], value_loss)
    torch.testing.assert_close(loss, expected + value_loss)
    # With values but without weights, steps count alike.
    alike = build("dt", sizes, max_return=True).eval()
    alike.load_state_dict(policy.state_dict())
    torch.testing.assert_close(alike.loss(windows)[1]["action_loss"], losses.mean())
    # The weights do not teach the values to please the loss.
    gradient = torch.autograd.grad(loss - value_loss, list(policy.values.parameters()))
    assert all(float(each.abs().max()) < 1e-6 for each in gradient)


def test_exposure_reaches_as_far_as_the_context() -> None:
    for context, window, lags in ((K, 3, 3), (K, 10, K - 1), (1, 10, 0)):
        policy = build("dt", TAGGED, exposure=True, exposure_window=window, context=context)
        term = policy.head.exposure
        assert (0 if term is None else term.lags) == lags
    with pytest.raises(InputError, match=r"policy\.exposure_window is 0"):
        build("dt", TAGGED, exposure=True, exposure_window=0)


def test_the_largest_return_is_in_reward_units() -> None:
    policy, windows = build("dt", VECTORS, max_return=True).eval(), random_windows(VECTORS)
    small = policy.max_return(windows)
    policy.return_scale.fill_(10.0)
    torch.testing.assert_close(policy.max_return(windows), 10 * small)
    asked = replace(windows, returns_to_go=windows.returns_to_go + 7)
    assert torch.equal(policy.max_return(asked), policy.max_return(windows))


def expectile(returns: Tensor, share: float) -> float:
    """By bisection: upward and downward deviations balance as share to 1 − share."""
    low, high = float(returns.min()), float(returns.max())
    for _ in range(200):
        middle = (low + high) / 2
        above = share * (returns - middle).clamp(min=0).sum()
        below = (1 - share) * (middle - returns).clamp(min=0).sum()
        low, high = (middle, high) if above > below else (low, middle)
    return (low + high) / 2


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=12))
def test_the_loss_is_least_at_the_mean_and_the_expectile(sample: list[float]) -> None:
    returns = torch.tensor(sample, dtype=torch.float64)
    best = torch.tensor([float(returns.mean()), expectile(returns, BEST)], dtype=torch.float64)

    def loss(values: Tensor) -> float:
        return float(ValueHead.loss(values.expand(len(returns), 2), returns))

    lowest = loss(best)
    for moved in torch.tensor([[0.1, 0], [-0.1, 0], [0, 0.1], [0, -0.1]]):
        assert loss(best + moved) > lowest


@pytest.mark.parametrize("t", [0, 3])
def test_a_value_reads_its_history_and_nothing_else(t: int) -> None:
    torch.manual_seed(0)
    head, windows = ValueHead(VECTORS["state"], 16), random_windows(VECTORS, padding=(0, 0, 0))
    actions = torch.randn(len(windows.mask), K, 16, requires_grad=True)
    before = head(windows, actions)
    assert not torch.autograd.grad(before.sum(), actions, allow_unused=True)[0]
    states, played = windows.states.clone(), actions.detach().clone()
    states[:, t + 1 :] += 1
    played[:, t:] += 1
    changed = changed_at(windows, slice(None), ("rewards", "returns_to_go"))
    after = head(replace(changed, states=states), played)
    torch.testing.assert_close(before[:, : t + 1], after[:, : t + 1])
    assert not torch.allclose(before[:, t + 1 :], after[:, t + 1 :])
    first = head(changed_at(windows, (slice(None), 0), ("states",)), actions)
    assert not torch.allclose(before[:, t], first[:, t])
    later = head(replace(windows, timesteps=windows.timesteps + 5), actions)
    assert not torch.allclose(before[:, t], later[:, t])


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=1))
def test_weights_are_clipped_exponentials_with_mean_one(pairs: list[tuple[float, float]]) -> None:
    returns, means = torch.tensor(pairs, dtype=torch.float64).unbind(1)
    values = torch.stack([means, torch.full_like(means, 99.0)], dim=1).requires_grad_()
    weights = advantage_weights(values, returns)
    assert not weights.requires_grad
    assert float(weights.mean()) == pytest.approx(1)
    # e³ : e⁻⁵ is as far as two steps can be apart.
    assert float(weights.max() / weights.min()) <= torch.e**8 * (1 + 1e-6)
    advantage = returns - means
    spread = float(advantage.std(correction=0))
    if spread == 0:
        torch.testing.assert_close(weights, torch.ones_like(weights))
    if spread > 1e-3:
        expected = (advantage / spread).clamp(-5, 3).exp()
        torch.testing.assert_close(weights, expected / expected.mean())
    assert (weights[advantage.argsort()].diff() >= -1e-12).all()
