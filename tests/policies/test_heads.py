"""Heads: ranges, likelihoods, and what sampling the softmax may and may not change."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from ucfrec.policies.heads import ItemHead, VectorHead, head_from

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


# Vectors.


@given(st.floats(0.01, 1e3), st.floats(1e-3, 1e4), st.integers(0, 99))
def test_vector_actions_stay_in_range(scale: float, size: float, seed: int) -> None:
    torch.manual_seed(seed)
    head = VectorHead(DIM, 3)
    head.scale.copy_(torch.tensor([scale, 1.0, 0.5]))
    predicted = head.predict(size * torch.randn(50, 4, DIM))
    assert predicted.shape == (50, 4, 3)
    assert (predicted.abs() <= head.scale).all()


def test_the_whole_range_can_be_reached() -> None:
    head = VectorHead(DIM, 2)
    head.scale.copy_(torch.tensor([3.0, 0.5]))
    wanted = torch.tensor([2.9, -0.49])
    optimizer = torch.optim.Adam(head.out.parameters(), lr=0.1)
    for _ in range(300):
        optimizer.zero_grad()
        head.loss(torch.ones(1, DIM), wanted.unsqueeze(0)).backward()
        optimizer.step()
    torch.testing.assert_close(head.predict(torch.ones(DIM)), wanted, rtol=0.04, atol=0)


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


def test_actions_are_embedded_by_their_share_of_the_range() -> None:
    torch.manual_seed(0)
    narrow, wide = VectorHead(DIM, 2), VectorHead(DIM, 2)
    wide.load_state_dict(narrow.state_dict())
    wide.scale.fill_(8.0)
    actions = torch.rand(3, 4, 2)
    torch.testing.assert_close(wide.embed(8 * actions), narrow.embed(actions))


# Items.


def test_item_loss_is_the_negative_log_likelihood() -> None:
    head, _ = item_head()
    features, actions = steps(head, 9)
    probabilities = head.predict(features).softmax(-1).detach()
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(9))
    expected = -sum(math.log(float(probabilities[m, a])) for m, a in enumerate(actions)) / 9
    assert float(head.loss(features, actions).detach()) == pytest.approx(expected, rel=1e-5)


def test_an_item_is_scored_by_the_vector_it_is_embedded_by() -> None:
    head, _ = item_head()
    features, actions = steps(head, 5)
    scores = head.predict(features)[torch.arange(5), actions]
    by_hand = (features * head.embed(actions)).sum(-1) / DIM**0.5 + head.bias[actions]
    torch.testing.assert_close(scores, by_hand)


def test_an_untrained_policy_recommends_what_is_popular() -> None:
    counts = torch.tensor([5.0, 0.0, 93.0, 2.0])
    head = ItemHead(DIM, 4, 5)
    head.start_from(torch.randn(4, 5), counts)
    shares = head.predict(torch.zeros(DIM)).softmax(-1)
    assert shares.argmax() == 2
    # One is added to every count, so that an item never shown can still be recommended.
    torch.testing.assert_close(shares, (counts + 1) / 104)


def test_items_with_the_same_embedding_start_alike() -> None:
    head = ItemHead(DIM, 3, 5)
    embeddings = torch.randn(3, 5)
    embeddings[2] = embeddings[0]
    head.start_from(embeddings, torch.zeros(3))
    logits = head.predict(torch.randn(6, DIM))
    torch.testing.assert_close(logits[:, 2], logits[:, 0])
    assert not torch.allclose(logits[:, 1], logits[:, 0])


@pytest.mark.parametrize("negatives", [500, 20_000])
def test_the_sampled_loss_approaches_the_full_one(negatives: int) -> None:
    head, _ = item_head()
    features, actions = steps(head, 200)
    full = head.loss(features, actions).detach()
    torch.manual_seed(0)
    draws = torch.stack(
        [head.sampled_loss(features, actions, negatives).detach() for _ in range(30)]
    )
    assert float(draws.mean()) == pytest.approx(float(full), rel=0.05 if negatives < 1000 else 0.01)


def test_its_gradient_approaches_the_full_one() -> None:
    head, _ = item_head()
    features, actions = steps(head, 200)
    torch.manual_seed(0)
    gradients = []
    for loss in (
        head.loss(features, actions),
        torch.stack([head.sampled_loss(features, actions, 5000) for _ in range(10)]).mean(),
    ):
        head.zero_grad()
        loss.backward()
        assert head.bias.grad is not None
        assert head.correction.grad is not None
        gradients.append(torch.cat([head.bias.grad, head.correction.grad.flatten()]).clone())
    assert F.cosine_similarity(gradients[0], gradients[1], dim=0) > 0.99
    assert float(gradients[1].norm() / gradients[0].norm()) == pytest.approx(1, rel=0.1)


def test_learning_from_samples_finds_the_true_shares() -> None:
    """Without the correction for Q, an item would be learnt as rarer the oftener it is sampled:
    by a factor of ten between the first and the last here."""
    counts = torch.tensor([400.0, 20, 100, 80, 60, 40])
    shown = torch.tensor([240, 20, 40, 20, 20, 60])
    head = ItemHead(DIM, 6, 5)
    head.start_from(torch.zeros(6, 5), counts)
    torch.manual_seed(0)
    actions = torch.repeat_interleave(torch.arange(6), shown)
    features = torch.zeros(len(actions), DIM)
    optimizer = torch.optim.Adam([head.bias], lr=0.05)
    for _ in range(200):
        optimizer.zero_grad()
        head.sampled_loss(features, actions, 200).backward()
        optimizer.step()
    learnt = head.predict(torch.zeros(DIM)).detach().softmax(-1)
    torch.testing.assert_close(learnt, shown / shown.sum(), rtol=0.15, atol=0.01)


def test_a_store_of_items_or_of_vectors_gets_its_head() -> None:
    assert isinstance(head_from({"items": 7, "action": 3}, DIM), ItemHead)
    assert isinstance(head_from({"items": 0, "action": 3}, DIM), VectorHead)
