"""Heads: ranges, likelihoods, and what sampling the softmax may and may not change."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from ucfrec.episodes.exposure import ExposureTerm, Likeness
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed
from ucfrec.policies import heads
from ucfrec.policies.heads import ItemHead, Proposal, VectorHead
from ucfrec.user_model.running import HALF_LIVES_OF_DEMAND, Demand, TimeBins

N, DIM = 60, 8


def item_head() -> ItemHead:
    """A head with popular and rare items."""
    torch.manual_seed(0)
    head = ItemHead(DIM, N, 5)
    head.start_from(torch.randn(N, 5), torch.floor(2000 / torch.arange(1, N + 1)) - 1)
    head.correction.data += 0.3 * torch.randn_like(head.correction)
    return head


def steps(head: ItemHead, m: int) -> tuple[Tensor, Tensor]:
    """Features, and actions of which popular ones are more frequent."""
    generator = torch.Generator().manual_seed(1)
    features = 2 * torch.randn(m, DIM, generator=generator)
    return features, torch.multinomial(head.counts, m, True, generator=generator)


@given(st.floats(0.01, 1e3), st.floats(1e-3, 1e4), st.integers(0, 99))
def test_vectors_stay_in_range_and_their_error_is_in_shares_of_it(
    scale: float, size: float, seed: int
) -> None:
    torch.manual_seed(seed)
    head = VectorHead(DIM, 3)
    head.scale.copy_(torch.tensor([scale, 1.0, 0.5]))
    features, actions = size * torch.randn(50, DIM), torch.randn(50, 3)
    predicted = head.predict(features).detach()
    assert (predicted.abs() <= head.scale).all()
    expected = np.mean(((predicted - actions) / head.scale).numpy() ** 2)
    found = head.losses(features, actions).mean().detach()
    assert float(found) == pytest.approx(expected, rel=1e-4)


def test_an_untrained_policy_recommends_what_is_popular() -> None:
    counts = torch.tensor([5.0, 0.0, 93.0, 2.0])
    head = ItemHead(DIM, 4, 5)
    head.start_from(torch.randn(4, 5), counts)
    shares = head.predict(torch.zeros(DIM)).softmax(-1)
    assert shares.argmax() == 2
    # One is added to every count, so that an item never shown can still be recommended.
    torch.testing.assert_close(shares, (counts + 1) / 104)


def test_its_gradient_approaches_the_full_one() -> None:
    head = item_head()
    features, actions = steps(head, 200)
    full = gradients_of(head, lambda: head.losses(features, actions))
    differences = []
    for samples in (20, 100, 1000):
        head.samples = samples
        drawn = gradients_of(head, lambda: sum(head.losses(features, actions) for _ in range(40)))
        differences.append(float((drawn / 40 - full).norm() / full.norm()))
    assert differences[0] > differences[1] > differences[2] < 0.01


def gradients_of(module: nn.Module, loss: Callable[[], Tensor]) -> Tensor:
    """The gradient of `loss` by all parameters of the module."""
    module.zero_grad()
    loss().mean().backward()  # type: ignore[no-untyped-call]
    found = [parameter.grad for parameter in module.parameters()]
    return torch.cat([each.to_dense().flatten() for each in found if each is not None])


def test_in_evaluation_mode_the_loss_is_that_of_all_items(monkeypatch: pytest.MonkeyPatch) -> None:
    head = exposed_head(True)
    (features, actions), shown = steps(head, 50), shown_before(50)
    full = head.losses(features, actions, shown)
    monkeypatch.setattr(heads, "_AT_ONCE", 50 * 7)
    head.eval().samples = 10
    with torch.no_grad():
        torch.testing.assert_close(head.losses(features, actions, shown), full)


def test_entropy_is_estimated_from_samples() -> None:
    head = exposed_head(True)
    features, shown = steps(head, 100)[0], shown_before(100)
    probabilities = head.predict(features, shown).detach().softmax(-1)
    expected = float(-(probabilities * probabilities.log()).sum(-1).mean())
    assert float(head.entropy(features, shown).detach()) == pytest.approx(expected, rel=1e-5)
    torch.manual_seed(0)
    head.samples = 200
    estimated = [float(head.entropy(features, shown).detach()) for _ in range(10)]
    assert sum(estimated) / 10 == pytest.approx(expected, rel=0.02)


def test_gradients_have_the_rows_that_took_part_only() -> None:
    torch.manual_seed(0)
    head = ItemHead(DIM, 50_000, 5, samples=64)
    head.start_from(torch.randn(50_000, 5), torch.rand(50_000))
    features, actions = torch.randn(32, DIM), torch.randint(50_000, (32,))
    head.losses(features, actions).mean().backward()  # type: ignore[no-untyped-call]
    for table in (head.correction, head.bias):
        assert table.grad.is_sparse
        rows = table.grad.coalesce().indices()[0]
        assert len(rows) <= 96
        assert torch.isin(actions, rows).all()


LAGS = 4


def exposed_head(tags: bool) -> ItemHead:
    """The head of `item_head` with an exposure term that matters."""
    plain = item_head()
    generator = torch.Generator().manual_seed(5)
    states = ItemStates(plain.embeddings, torch.zeros(0, 0), 0.0, 1.0)
    if tags:
        states = replace(states, tags=torch.randint(-1, 9, (N, 2), generator=generator))
    head = ItemHead(DIM, N, 5, ExposureTerm(LAGS, 3, Likeness.of(states)))
    head.load_state_dict(plain.state_dict(), strict=False)
    head.exposure.start_from(states, torch.linspace(0, 2, 50))
    for parameter in head.exposure.parameters():
        parameter.data = 0.1 * torch.randn(parameter.shape, generator=generator)
    return head


def shown_before(m: int) -> Exposed:
    torch.manual_seed(9)
    items = torch.randint(-1, N // 2, (m, LAGS))
    return Exposed(items, torch.rand(m, LAGS), 2 * torch.rand(m))


@pytest.mark.parametrize("tags", [True, False])
def test_exposure_is_added_to_the_logits(tags: bool) -> None:
    head = exposed_head(tags)
    (features, actions), shown = steps(head, 9), shown_before(9)
    logits, plain = head.predict(features, shown), head.predict(features)
    added = head.exposure.added_to(torch.zeros(9, N), shown)
    torch.testing.assert_close(logits, plain + added)
    assert (logits - plain).abs().max() > 0.5
    losses = head.losses(features, actions, shown)
    expected = -logits.log_softmax(-1)[torch.arange(9), actions]
    torch.testing.assert_close(losses, expected)
    some = torch.tensor([0, 3, 4, 31, N - 1])
    torch.testing.assert_close(head.predict(features, shown, some), logits[:, some])


def test_vectors_are_kept_until_a_weight_changes() -> None:
    head = item_head().eval()
    features = torch.randn(4, DIM)
    optimizer = torch.optim.AdamW(head.parameters(), lr=0.1, fused=True)

    def check() -> Tensor:
        vectors = head.vectors(torch.arange(N))
        expected = features @ vectors.T / DIM**0.5 + head.bias + head.recency
        with torch.no_grad():
            assert head.all_vectors() is head.all_vectors()
            found = head.predict(features)
        torch.testing.assert_close(found, expected.detach())
        return found

    before = check()
    head.losses(features, torch.arange(4)).mean().backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    assert not torch.allclose(check(), before)
    head.start_from(torch.randn(N, 5), torch.rand(N))
    check()
    head.load_state_dict({name: value + 1 for name, value in head.state_dict().items()})
    check()
    head.train()
    head.correction.data += 1
    head.eval()
    check()


@given(st.integers(1, 300), st.integers(1, 200), st.integers(0, 99))
def test_candidates_are_ascending_and_count_every_draw(n: int, draws: int, seed: int) -> None:
    torch.manual_seed(seed)
    proposal = Proposal(torch.rand(n) + 0.01)
    items, log_weights = proposal.draw(draws)
    assert (items.diff() > 0).all()
    assert 0 <= items.min() <= items.max() < n
    copies = log_weights.exp() * draws * proposal.share[items]
    torch.testing.assert_close(copies, copies.round(), atol=1e-3, rtol=1e-3)
    assert round(float(copies.sum())) == draws
    # One draw in each of equal parts: fewer than two from what is expected.
    assert ((copies - draws * proposal.share[items]).abs() < 2).all()


def test_rare_items_are_drawn_evenly_and_popular_ones_by_their_counts() -> None:
    share = Proposal(torch.cat([torch.ones(1000) * 1e-6, torch.tensor([3.0, 1.0])])).share
    assert float(share.sum()) == pytest.approx(1)
    assert float(share[0] / share[1]) == pytest.approx(1)
    assert float(share[:1000].sum()) > 0.49
    assert 2.9 < float(share[1000] / share[1001]) < 3


def test_logits_follow_demand_at_the_time_of_training_steps_and_the_latest_in_acting() -> None:
    head, features = item_head(), torch.randn(3, DIM)
    logs = torch.randn(3, N).log_softmax(1)
    mixture = torch.eye(len(HALF_LIVES_OF_DEMAND))[0]
    head.follow(Demand(TimeBins(100, 10, 2), mixture, logs))
    nothing = torch.zeros(3, 0)
    exposed = Exposed(nothing.long(), nothing, torch.zeros(3), times=torch.tensor([99, 112, 500]))
    items = torch.tensor([0, 3, N - 1])
    of_network = features @ head.vectors(torch.arange(N)).T / DIM**0.5 + head.bias - head.prior
    for rows in ([0, 1, 2], [2, 2, 2]):  # in training, then in evaluation mode
        expected = of_network + logs[rows]
        torch.testing.assert_close(head.predict(features, exposed), expected)
        torch.testing.assert_close(head.predict(features, exposed, items), expected[:, items])
        of_items = expected.gather(1, items.unsqueeze(1))[:, 0]
        torch.testing.assert_close(head.logit(features, items, exposed), of_items)
        head.eval()
