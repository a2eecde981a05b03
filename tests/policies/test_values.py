"""Values of states: the mean and the expectile of returns-to-go, and the weights made of them."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.policies.test_ucf import VECTORS, K, random_windows
from ucfrec.episodes.windows import Windows
from ucfrec.policies.values import BEST, ValueHead, advantage_weights

S, DIM = VECTORS["state"], 16


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
    for step in (-0.1, 0.1):
        for place in range(2):
            moved = best.clone()
            moved[place] += step
            assert loss(moved) > lowest


@pytest.mark.parametrize("sample", ["uniform", "two values"])
def test_a_fitted_head_knows_both(sample: str) -> None:
    """Of returns from 0 to 1, or of 0 and 1 alike: the expectile is √τ / (√τ + √(1 − τ)), or τ."""
    torch.manual_seed(0)
    returns = torch.linspace(0, 1, 400) if sample == "uniform" else torch.arange(400) % 2 * 1.0
    head, none = ValueHead(S, DIM), torch.zeros(len(returns), 1)
    steps = torch.zeros(len(returns), 1, dtype=torch.int64)
    states, actions = torch.zeros(len(returns), 1, S), torch.zeros(len(returns), 1, DIM)
    windows = Windows(states, steps, none, returns.unsqueeze(1), steps, torch.ones_like(none) > 0)
    optimizer = torch.optim.Adam(head.parameters(), lr=0.01)
    for _ in range(600):
        optimizer.zero_grad()
        ValueHead.loss(head(windows, actions)[:, 0], returns).backward()
        optimizer.step()
    mean, best = head(windows, actions)[0, 0].tolist()
    exact = BEST**0.5 / (BEST**0.5 + (1 - BEST) ** 0.5) if sample == "uniform" else BEST
    assert mean == pytest.approx(0.5, abs=0.02)
    assert best == pytest.approx(exact, abs=0.02)
    assert exact == pytest.approx(expectile(returns, BEST), abs=0.01)


@pytest.mark.parametrize("t", [0, 3])
def test_a_value_reads_its_history_and_nothing_else(t: int) -> None:
    """States and step numbers up to t, and actions before t."""
    torch.manual_seed(0)
    head, windows = ValueHead(S, DIM), random_windows(VECTORS, padding=(0, 0, 0))
    actions = torch.randn(len(windows.mask), K, DIM, requires_grad=True)
    before = head(windows, actions)
    assert before.shape == (*windows.mask.shape, 2)
    assert not torch.autograd.grad(before.sum(), actions, allow_unused=True)[0]
    states, played = windows.states.clone(), actions.detach().clone()
    states[:, t + 1 :] += 1
    played[:, t:] += 1
    future = replace(
        windows, states=states, rewards=windows.rewards + 1,
        returns_to_go=windows.returns_to_go + 1,
    )  # fmt: skip
    after = head(future, played)
    torch.testing.assert_close(before[:, : t + 1], after[:, : t + 1])
    assert not torch.allclose(before[:, t + 1 :], after[:, t + 1 :])
    states = windows.states.clone()
    states[:, 0] += 1
    assert not torch.allclose(before[:, t], head(replace(windows, states=states), actions)[:, t])
    later = head(replace(windows, timesteps=windows.timesteps + 5), actions)
    assert not torch.allclose(before[:, t], later[:, t])


def test_padding_does_not_move_a_value() -> None:
    torch.manual_seed(0)
    head, windows = ValueHead(S, DIM), random_windows(VECTORS)
    actions = torch.randn(len(windows.mask), K, DIM)
    values = head(windows, actions)
    steps = windows.mask.unsqueeze(-1)
    noisy = replace(windows, states=torch.where(steps, windows.states, 9.0))
    other = head(noisy, torch.where(steps, actions, 9.0))
    torch.testing.assert_close(values[windows.mask], other[windows.mask])
    short = Windows(**{f: getattr(windows, f)[2:, 5:] for f in windows.__dataclass_fields__})
    torch.testing.assert_close(head(short, actions[2:, 5:]), values[2:, 5:])


returns_and_values = st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=1)


@given(returns_and_values)
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
    if spread > 1e-3:
        expected = (advantage / spread).clamp(-5, 3).exp()
        torch.testing.assert_close(weights, expected / expected.mean())
    order = advantage.argsort()
    assert (weights[order].diff() >= -1e-12).all()


def test_steps_without_advantage_count_alike() -> None:
    values = torch.tensor([[2.0, 3.0]]).repeat(4, 1)
    assert advantage_weights(values, torch.full((4,), 2.0)).tolist() == [1, 1, 1, 1]
    assert advantage_weights(values, torch.full((4,), 7.0)).tolist() == [1, 1, 1, 1]
    assert advantage_weights(values[:1], torch.tensor([5.0])).tolist() == [1]


def test_one_outlier_does_not_outweigh_the_rest() -> None:
    values, returns = torch.zeros(1000, 2), torch.zeros(1000)
    returns[0] = 1e6
    weights = advantage_weights(values, returns)
    assert float(weights[0]) < 21
    assert float(weights[1]) > 0.9
