"""Losses that ignore padding, and the supervision of attention, against plain loops."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ucfrec.policies.losses import EPSILON, mask_loss, masked_mean, parent_targets

masks = st.integers(1, 6).flatmap(
    lambda length: st.lists(st.integers(0, length - 1), min_size=1, max_size=4).map(
        lambda padding: torch.arange(length) >= torch.tensor(padding).unsqueeze(1)
    )
)
"""(B, K), padded on the left, with one step at least."""
weights = st.sampled_from([0.0, 0.3, 0.6, 1.0])


def naive_targets(mask: Tensor, window: int, decay: float, previous_action: float) -> np.ndarray:
    batch, length = mask.shape
    targets = np.zeros((batch, length, 3 * length))
    for b in range(batch):
        for t in range(length):
            if not mask[b, t]:
                continue
            parents = {3 * t: 1.0, 3 * t + 1: 1.0}  # Ĝ_t and s_t
            for k in range(1, window + 1):
                if t - k >= 0 and mask[b, t - k]:
                    parents[3 * (t - k) + 1] = decay**k
            if t >= 1 and mask[b, t - 1]:
                parents[3 * (t - 1) + 2] = previous_action
            for token, weight in parents.items():
                targets[b, t, token] = weight / sum(parents.values())
    return targets


@given(masks, st.integers(0, 4), weights, weights)
def test_targets_equal_a_plain_loop(
    mask: Tensor, window: int, decay: float, previous_action: float
) -> None:
    got = parent_targets(mask, window, decay, previous_action)
    np.testing.assert_allclose(
        got, naive_targets(mask, window, decay, previous_action), rtol=1e-6, atol=1e-7
    )


@given(masks, st.integers(1, 4), st.integers(0, 99))
def test_mask_loss_equals_a_plain_loop(mask: Tensor, heads: int, seed: int) -> None:
    targets = parent_targets(mask, 2, 0.6, 0.2)
    batch, length = mask.shape
    generator = torch.Generator().manual_seed(seed)
    attention = torch.randn(batch, heads, length, 3 * length, generator=generator).softmax(-1)
    rows = [
        -math.fsum(
            float(targets[b, t, i]) * math.log(float(attention[b, h, t, i]) + EPSILON)
            for i in range(3 * length)
        )
        for b in range(batch)
        for h in range(heads)
        for t in range(length)
        if mask[b, t]
    ]
    assert float(mask_loss(attention, targets, mask)) == pytest.approx(np.mean(rows), rel=1e-5)


@given(masks, st.sampled_from([math.nan, math.inf, -math.inf, 1e30]), st.integers(0, 99))
def test_padding_has_no_part_in_a_mean(mask: Tensor, junk: float, seed: int) -> None:
    values = torch.randn(mask.shape, generator=torch.Generator().manual_seed(seed))
    with_junk = torch.where(mask, values, junk).requires_grad_()
    mean = masked_mean(with_junk, mask)
    kept = [float(v) for v, there in zip(values.flatten(), mask.flatten(), strict=True) if there]
    assert float(mean.detach()) == pytest.approx(np.mean(kept), abs=1e-6)
    mean.backward()
    expected = mask.float() / mask.sum()
    assert with_junk.grad is not None
    torch.testing.assert_close(with_junk.grad, expected)
