"""Layers that cost less than PyTorch's do the same."""

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from ucfrec.policies.layers import CausalDepthwise, Dropout, attend, kept, some_padding


@pytest.mark.parametrize("padded", [False, True])
def test_shifted_products_are_the_convolution_and_have_its_gradients(padded: bool) -> None:
    torch.manual_seed(0)
    layer = CausalDepthwise(6)
    mask = torch.arange(5) >= torch.tensor([[0], [2], [4]])
    steps = torch.randn(3, 5, 6, requires_grad=True)
    weights = torch.randn(3, 5, 6)

    def convolution(x: torch.Tensor) -> torch.Tensor:
        x = x.masked_fill(~mask.unsqueeze(-1), 0.0) if padded else x
        return nn.Conv1d.forward(layer, F.pad(x.transpose(1, 2), (2, 0))).transpose(1, 2)

    found, right = layer(steps, mask if padded else None), convolution(steps)
    torch.testing.assert_close(found, right)
    inputs = (steps, layer.weight, layer.bias)
    gradients = (torch.autograd.grad((out * weights).sum(), inputs) for out in (found, right))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


def test_a_convolution_of_fewer_steps_than_it_reaches_back() -> None:
    layer = CausalDepthwise(4)
    steps = torch.randn(2, 1, 4, requires_grad=True)
    layer(steps).sum().backward()  # type: ignore[no-untyped-call]
    assert steps.grad is not None
    torch.testing.assert_close(steps.grad[0, 0], layer.weight[:, 0, 2].detach())


@pytest.mark.parametrize("p", [0.1, 0.5, 0.93])
def test_the_given_share_is_dropped_and_the_mean_stays(p: float) -> None:
    torch.manual_seed(0)
    mask = kept(torch.Size((401, 999)), p)
    assert float((mask == 0).float().mean()) == pytest.approx(p, abs=0.004)
    torch.testing.assert_close(mask.max(), torch.tensor(1 / (1 - p)), rtol=1e-3, atol=0)
    # Neighbours share a draw of 64 bits, but not their fate.
    together = ((mask[:, 1:] == 0) & (mask[:, :-1] == 0)).float().mean()
    assert float(together) == pytest.approx(p**2, abs=0.004)


def test_dropout_follows_the_seed_and_rests_in_evaluation() -> None:
    layer, values, residual = Dropout(0.3), torch.randn(7, 11), torch.randn(7, 11)
    drawn = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        drawn.append(layer(values))
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    torch.manual_seed(1)
    torch.testing.assert_close(layer.add(residual, values), residual + drawn[0])
    layer.eval()
    assert torch.equal(layer(values), values)
    assert torch.equal(layer.add(residual, values), residual + values)


def test_attention_drops_weights_and_keeps_the_mean() -> None:
    torch.manual_seed(0)
    query, key, value = (torch.randn(3, 2, 5, 4) for _ in range(3))
    visible = torch.ones(5, 5, dtype=torch.bool).tril().expand(3, 1, 5, 5)
    right = F.scaled_dot_product_attention(query, key, value, visible)
    torch.testing.assert_close(attend(query, key, value, visible, 0.0), right)
    # A share too small to drop anything here is the same computation.
    torch.testing.assert_close(attend(query, key, value, visible, 1e-6), right)
    drawn = torch.stack([attend(query, key, value, visible, 0.3) for _ in range(4000)])
    torch.testing.assert_close(drawn.mean(0), right, rtol=0, atol=0.06)
    # The first row sees one column, whose weight is 1: dropped, or divided by 0.7.
    first = drawn[:, 0, 0, 0] / value[0, 0, 0]
    assert float((first == 0).float().mean()) == pytest.approx(0.3, abs=0.03)
    torch.testing.assert_close(
        first[first != 0], torch.full_like(first[first != 0], 1 / 0.7), rtol=1e-3, atol=0
    )


def test_everything_or_nothing_can_be_dropped() -> None:
    values = torch.randn(5)
    assert torch.equal(Dropout(1.0)(values), torch.zeros(5))
    assert torch.equal(Dropout(0.0)(values), values)


def test_only_windows_with_padding_need_their_mask() -> None:
    mask = torch.ones(2, 3, dtype=torch.bool)
    assert some_padding(mask) is None
    mask[0, 0] = False
    assert some_padding(mask) is mask
