"""Heads: ranges, likelihoods, and what sampling the softmax may and may not change."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from tests.policies.test_ucf import VECTORS, K, random_windows
from ucfrec.episodes.exposure import ExposureTerm, Likeness
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed, Windows
from ucfrec.policies import heads
from ucfrec.policies.heads import (
    BEST,
    ItemHead,
    Proposal,
    ValueHead,
    VectorHead,
    advantage_weights,
    head_from,
)

N, DIM = 60, 8


def item_head(n: int = N, seed: int = 0) -> tuple[ItemHead, Tensor]:
    """A head with popular and rare items, and its counts."""
    torch.manual_seed(seed)
    counts = torch.floor(2000 / torch.arange(1, n + 1)) - 1
    head = ItemHead(DIM, n, 5)
    head.start_from(torch.randn(n, 5), counts)
    head.requires_grad_(False)
    head.correction += 0.3 * torch.randn_like(head.correction)
    return head.requires_grad_(True), counts


def steps(head: ItemHead, m: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    """Features, and actions of which popular ones are more frequent."""
    generator = torch.Generator().manual_seed(seed)
    features = 2 * torch.randn(m, DIM, generator=generator)
    return features, torch.multinomial(head.counts, m, True, generator=generator)


def sampling(head: ItemHead, samples: int) -> ItemHead:
    """The head, trained from now on with this number of draws for a batch."""
    head.samples = samples
    return head


# Vectors.


@given(st.floats(0.01, 1e3), st.floats(1e-3, 1e4), st.integers(0, 99))
def test_vector_actions_stay_in_range(scale: float, size: float, seed: int) -> None:
    torch.manual_seed(seed)
    head = VectorHead(DIM, 3)
    head.scale.copy_(torch.tensor([scale, 1.0, 0.5]))
    predicted = head.predict(size * torch.randn(50, 4, DIM))
    assert predicted.shape == (50, 4, 3)
    assert (predicted.abs() <= head.scale).all()


def test_vector_loss_is_the_mean_squared_error_in_shares_of_the_range() -> None:
    torch.manual_seed(0)
    head = VectorHead(DIM, 2)
    head.scale.copy_(torch.tensor([4.0, 0.5]))
    features, actions = torch.randn(7, DIM), torch.randn(7, 2)
    predicted = head.predict(features).detach()
    errors = [
        ((float(predicted[m, i]) - float(actions[m, i])) / float(head.scale[i])) ** 2
        for m in range(7)
        for i in range(2)
    ]
    assert float(head.loss(features, actions).detach()) == pytest.approx(sum(errors) / 14, rel=1e-5)
    assert float(head.loss(features, predicted).detach()) == 0


# Items.


def test_item_loss_is_the_negative_log_likelihood() -> None:
    head, _ = item_head()
    features, actions = steps(head, 9)
    probabilities = head.predict(features).softmax(-1).detach()
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(9))
    expected = -sum(math.log(float(probabilities[m, a])) for m, a in enumerate(actions)) / 9
    assert float(head.loss(features, actions).detach()) == pytest.approx(expected, rel=1e-5)


def test_an_untrained_policy_recommends_what_is_popular() -> None:
    counts = torch.tensor([5.0, 0.0, 93.0, 2.0])
    head = ItemHead(DIM, 4, 5)
    head.start_from(torch.randn(4, 5), counts)
    shares = head.predict(torch.zeros(DIM)).softmax(-1)
    assert shares.argmax() == 2
    # One is added to every count, so that an item never shown can still be recommended.
    torch.testing.assert_close(shares, (counts + 1) / 104)


def test_its_gradient_approaches_the_full_one() -> None:
    head, _ = item_head()
    features, actions = steps(head, 200)
    torch.manual_seed(0)
    full = gradients_of(head, lambda: head.loss(features, actions))
    differences = []
    for samples in (20, 100, 1000):
        sampling(head, samples)
        sampled = gradients_of(
            head, lambda: torch.stack([head.loss(features, actions) for _ in range(40)]).mean()
        )
        differences.append(float((sampled - full).norm() / full.norm()))
    assert differences[0] > differences[1] > differences[2]
    assert differences[2] < 0.01


def gradients_of(module: nn.Module, loss: Callable[[], Tensor]) -> Tensor:
    """The gradient of `loss` by all parameters of the module."""
    module.zero_grad()
    loss().backward()  # type: ignore[no-untyped-call]
    found = [parameter.grad for parameter in module.parameters()]
    return torch.cat([each.to_dense().flatten() for each in found if each is not None])


def test_candidates_have_the_logits_that_they_have_among_all() -> None:
    for tags in (True, False):
        head, _ = exposed_head(tags)
        features, shown = steps(head, 50)[0], shown_before(50)
        some = torch.tensor([0, 3, 4, 31, N - 1])
        columns = head.predict_items(features, some, shown)
        torch.testing.assert_close(columns, head.predict(features, shown)[:, some])


def test_in_evaluation_mode_the_loss_is_that_of_all_items(monkeypatch: pytest.MonkeyPatch) -> None:
    head, _ = exposed_head(True)
    features, actions = steps(head, 50)
    shown = shown_before(50)
    full = head.losses(features, actions, shown)
    monkeypatch.setattr(heads, "_AT_ONCE", 50 * 7)
    sampling(head, 10).eval()
    torch.testing.assert_close(head.losses(features, actions, shown), full)
    with torch.no_grad():
        torch.testing.assert_close(head.losses(features, actions, shown), full)


def test_entropy_is_estimated_from_samples() -> None:
    head, _ = exposed_head(True)
    features, shown = steps(head, 100)[0], shown_before(100)
    probabilities = head.predict(features, shown).detach().softmax(-1)
    expected = float(-(probabilities * probabilities.log()).sum(-1).mean())
    assert float(head.entropy(features, shown).detach()) == pytest.approx(expected, rel=1e-5)
    torch.manual_seed(0)
    estimated = [float(sampling(head, 200).entropy(features, shown).detach()) for _ in range(10)]
    assert sum(estimated) / 10 == pytest.approx(expected, rel=0.02)


def test_gradients_have_the_rows_that_took_part_only() -> None:
    torch.manual_seed(0)
    head = ItemHead(DIM, 50_000, 5, samples=64)
    head.start_from(torch.randn(50_000, 5), torch.rand(50_000))
    features, actions = torch.randn(32, DIM), torch.randint(50_000, (32,))
    head.loss(features, actions).backward()  # type: ignore[no-untyped-call]
    for table in (head.correction, head.bias):
        assert table.grad is not None
        assert table.grad.is_sparse
        rows = table.grad.coalesce().indices()[0]
        assert len(rows) <= 96
        assert torch.isin(actions, rows).all()


# Items, with what was shown before.

LAGS = 4


def exposed_head(tags: bool) -> tuple[ItemHead, Tensor]:
    """The head of `item_head` with an exposure term that matters."""
    plain, counts = item_head()
    generator = torch.Generator().manual_seed(5)
    states = ItemStates(plain.embeddings, torch.zeros(0, 0), 0.0, 1.0)
    if tags:
        states = replace(states, tags=torch.randint(-1, 9, (N, 2), generator=generator))
    head = ItemHead(DIM, N, 5, ExposureTerm(LAGS, 3, Likeness.of(states)))
    head.load_state_dict(plain.state_dict(), strict=False)
    assert head.exposure is not None
    head.exposure.start_from(states, torch.linspace(0, 2, 50))
    for parameter in head.exposure.parameters():
        parameter.data = 0.1 * torch.randn(parameter.shape, generator=generator)
    return head, counts


def shown_before(m: int) -> Exposed:
    generator = torch.Generator().manual_seed(9)
    items = torch.randint(-1, N // 2, (m, LAGS), generator=generator)
    returns = 2 * torch.rand(m, generator=generator)
    return Exposed(items, torch.rand(m, LAGS, generator=generator), returns)


@pytest.mark.parametrize("tags", [True, False])
def test_exposure_is_added_to_the_logits(tags: bool) -> None:
    head, _ = exposed_head(tags)
    features, actions = steps(head, 9)
    shown = shown_before(9)
    assert head.exposure is not None
    logits, plain = head.predict(features, shown), head.predict(features)
    added = head.exposure.added_to(torch.zeros(9, N), shown)
    torch.testing.assert_close(logits, plain + added)
    assert (logits - plain).abs().max() > 0.5
    losses = head.losses(features, actions, shown)
    expected = -logits.log_softmax(-1)[torch.arange(9), actions]
    torch.testing.assert_close(losses, expected)
    torch.testing.assert_close(head.loss(features, actions, shown), losses.mean())


@pytest.mark.parametrize("tags", [True, False])
def test_sampling_the_softmax_sees_the_same_exposure(tags: bool) -> None:
    head, _ = exposed_head(tags)
    features, actions = steps(head, 200)
    shown = shown_before(200)
    full = head.losses(features, actions, shown).detach()
    without = head.losses(features, actions).detach()
    torch.manual_seed(0)
    sampling(head, 500)
    sampled = torch.stack([head.losses(features, actions, shown).detach() for _ in range(20)]).mean(
        0
    )
    assert float(sampled.mean()) == pytest.approx(float(full.mean()), rel=0.01)
    assert float((sampled - full).abs().max()) < 0.1 * float((without - full).abs().max())


def test_a_head_is_of_items_or_vectors_and_has_an_exposure_term_if_it_looks_back() -> None:
    sizes = {"items": 7, "action": 3, "tags": 2}
    head, plain = head_from(sizes, DIM, 5), head_from(sizes, DIM, 0)
    assert isinstance(head_from({"items": 0, "action": 3}, DIM), VectorHead)
    assert isinstance(head, ItemHead)
    assert isinstance(plain, ItemHead)
    assert head.exposure is not None
    assert (head.exposure.lags, head.exposure.likeness.tags.shape) == (5, (7, 2))
    assert plain.exposure is None


def test_vectors_are_kept_until_a_weight_changes() -> None:
    torch.manual_seed(0)
    head = ItemHead(8, N, 5)
    head.start_from(torch.randn(N, 5), torch.rand(N))
    features = torch.randn(4, 8)
    optimizer = torch.optim.AdamW(head.eval().parameters(), lr=0.1, fused=True)

    def kept() -> Tensor:
        with torch.no_grad():
            assert head.all_vectors() is head.all_vectors()
            return head.predict(features)

    def check() -> None:
        vectors = head.vectors(torch.arange(N))
        expected = features @ vectors.T / 8**0.5 + head.bias
        torch.testing.assert_close(kept(), expected.detach())

    check()
    before = kept()
    head.loss(features, torch.arange(4)).backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    assert not torch.allclose(kept(), before)
    check()
    head.start_from(torch.randn(N, 5), torch.rand(N))
    check()
    head.load_state_dict({name: value + 1 for name, value in head.state_dict().items()})
    check()
    head.double().float()
    check()
    head.train()
    head.correction.data += 1
    head.eval()
    check()


@given(st.integers(1, 300), st.integers(1, 200), st.integers(0, 99))
def test_candidates_are_ascending_and_count_every_draw(n: int, draws: int, seed: int) -> None:
    torch.manual_seed(seed)
    proposal = Proposal(torch.rand(n) + 0.01)
    found = proposal.draw(draws)
    assert (found.items.diff() > 0).all()
    assert 0 <= found.items.min() <= found.items.max() < n
    copies = found.log_weights.exp() * draws * proposal.share[found.items]
    torch.testing.assert_close(copies, copies.round(), atol=1e-3, rtol=1e-3)
    assert round(float(copies.sum())) == draws
    # One draw in each of equal parts: fewer than two from what is expected.
    assert ((copies - draws * proposal.share[found.items]).abs() < 2).all()


def test_rare_items_are_drawn_evenly_and_popular_ones_by_their_counts() -> None:
    counts = torch.cat([torch.ones(1000) * 1e-6, torch.tensor([3.0, 1.0])])
    share = Proposal(counts).share
    torch.testing.assert_close(share.sum(), torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(share[0] / share[1], torch.ones((), dtype=torch.float64))
    assert float(share[:1000].sum()) > 0.49
    assert 2.9 < float(share[1000] / share[1001]) < 3


S, WIDTH = VECTORS["state"], 16


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


@pytest.mark.parametrize("t", [0, 3])
def test_a_value_reads_its_history_and_nothing_else(t: int) -> None:
    """States and step numbers up to t, and actions before t."""
    torch.manual_seed(0)
    head, windows = ValueHead(S, WIDTH), random_windows(VECTORS, padding=(0, 0, 0))
    actions = torch.randn(len(windows.mask), K, WIDTH, requires_grad=True)
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
    head, windows = ValueHead(S, WIDTH), random_windows(VECTORS)
    actions = torch.randn(len(windows.mask), K, WIDTH)
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
