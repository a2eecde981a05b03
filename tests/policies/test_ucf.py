"""Invariants of the architectures: what must never move a prediction, and what must."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.windows import Sessions, Windows
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.convformers import LSDTConfig, LSDTPolicy
from ucfrec.policies.dt import attend
from ucfrec.policies.registry import policy_class
from ucfrec.policies.ucf import (
    EPSILON,
    CausalDepthwise,
    Dropout,
    UCFConfig,
    UCFPolicy,
    draw_mask,
    interleave,
    mask_loss,
    parent_targets,
)

B, K, S, A, ITEMS = 3, 7, 5, 2, 11
VECTORS = {"state": S, "action": A, "items": 0}
CATALOG = {"state": S, "action": 4, "items": ITEMS}
SMALL = {"context": K, "dim": 16}


def build(name: str, sizes: dict[str, int], **settings: Any) -> SequencePolicy:
    torch.manual_seed(0)
    policy_type = policy_class(name)
    own = {"kernel_groups": 4} if name == "lsdt" else {}
    policy = policy_type(policy_type.Config(**{**SMALL, **own, **settings}), sizes)
    if sizes["items"]:
        policy.head.start_from(torch.randn(ITEMS, 4), torch.rand(ITEMS))
    for parameter in policy.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return policy.eval()


def random_windows(sizes: dict[str, int], padding: tuple[int, ...] = (0, 2, 5)) -> Windows:
    generator = torch.Generator().manual_seed(1)
    mask = torch.arange(K) >= torch.tensor(padding).unsqueeze(1)
    actions = torch.rand(B, K, A, generator=generator) * 2 - 1
    if sizes["items"]:
        actions = torch.randint(ITEMS, (B, K), generator=generator)
    return Windows(
        states=torch.randn(B, K, S, generator=generator),
        actions=actions,
        rewards=torch.rand(B, K, generator=generator),
        returns_to_go=torch.rand(B, K, generator=generator),
        timesteps=(torch.arange(K) - torch.tensor(padding).unsqueeze(1)).clamp(min=0),
        mask=mask,
    )


def trained(
    policy: SequencePolicy, windows: Windows, steps: int, rate: float = 3e-3
) -> SequencePolicy:
    optimizer = torch.optim.Adam(policy.parameters(), lr=rate)
    policy.train()
    for step in range(steps):
        torch.manual_seed(step)
        optimizer.zero_grad()
        policy.loss(windows)[0].backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return policy.eval()


def sessions_of(windows: Windows, users: tuple[int, ...] = (2, 0, -1)) -> Sessions:
    """Sessions of which windows show all."""
    actions, mask = windows.actions[:, :-1], windows.mask[:, :-1]
    actions = actions.masked_fill(~mask, -1) if actions.ndim == 2 else actions
    collected, known = torch.tensor([0.0, 1.0, 2.5]).double(), torch.tensor(users)
    given = windows.rewards[:, :-1] * mask, windows.timesteps[:, -1], collected, known, 0 * known
    return Sessions(actions, *given, states=windows.states)


def other(values: Tensor) -> Tensor:
    """Something else of the same kind."""
    return (values + 1) % ITEMS if values.dtype == torch.int64 else values + 3.0


def predictions(policy: SequencePolicy, windows: Windows) -> Tensor:
    with torch.no_grad():
        return policy.head.predict(policy.features(policy.normalize(windows)))


both_heads = pytest.mark.parametrize("sizes", [VECTORS, CATALOG], ids=["vectors", "items"])
HISTORY = ("ucf", "dt", "dc", "lsdt", "dt4rec", "cdt4rec", "edt4rec", "sasrec")
sequence = pytest.mark.parametrize("name", HISTORY)


def changed_at(windows: Windows, where: Any, fields: tuple[str, ...]) -> Windows:
    changes = {}
    for field in fields:
        values = getattr(windows, field).clone()
        values[where] = other(values[where])
        changes[field] = values
    return replace(windows, **changes)


@both_heads
@pytest.mark.parametrize("name", [*HISTORY, "bc"])
def test_the_last_features_are_the_last_row_of_all(name: str, sizes: dict[str, int]) -> None:
    policy, windows = build(name, sizes), random_windows(sizes)
    with torch.no_grad():
        normalized = policy.normalize(windows)
        expected = policy.features(normalized)[:, -1]
        torch.testing.assert_close(policy.last_features(normalized), expected)


@both_heads
@sequence
@pytest.mark.parametrize("field", ["states", "actions", "returns_to_go"])
def test_the_past_moves_a_prediction(name: str, sizes: dict[str, int], field: str) -> None:
    policy, windows = build(name, sizes), random_windows(sizes)
    changed = predictions(policy, changed_at(windows, (slice(None), 5), (field,)))
    unused = name == "sasrec" and field != "actions"
    assert torch.equal(predictions(policy, windows)[:, -1], changed[:, -1]) is unused


def test_the_target_return_is_no_less_than_the_logs_had() -> None:
    policy, windows = build("dt", VECTORS), random_windows(VECTORS)
    policy.lowest_return_to_go.fill_(-0.5)
    low, lowest, more = (
        predictions(policy, replace(windows, returns_to_go=torch.full((B, K), returns)))
        for returns in (-40.0, -0.5, 0.0)
    )
    assert torch.equal(low, lowest)
    assert not torch.equal(more, lowest)


@both_heads
@sequence
def test_padding_is_inert(name: str, sizes: dict[str, int]) -> None:
    policy, windows = build(name, sizes), random_windows(sizes)
    dirty = changed_at(windows, ~windows.mask, ("states", "actions", "rewards", "returns_to_go"))
    dirty = replace(dirty, timesteps=windows.timesteps.masked_fill(~windows.mask, 3))
    here, losses = windows.mask, []
    torch.testing.assert_close(predictions(policy, windows)[here], predictions(policy, dirty)[here])
    for each in (windows, dirty):
        torch.manual_seed(3)
        losses.append(policy.loss(each)[0])
    torch.testing.assert_close(losses[0], losses[1])


def test_only_the_predicting_rows_are_computed_and_they_are_the_full_ones() -> None:
    policy = build("ucf", VECTORS)
    windows = random_windows(VECTORS, padding=(0, 0, 0))
    tokens = policy.embed(windows, policy.head.embed(windows.actions))
    streams = policy.return_stream, policy.state_stream, policy.action_stream
    own = [stream(token, windows.mask) for stream, token in zip(streams, tokens, strict=True)]
    nothing = [torch.zeros_like(own[0])] * 2
    known = (torch.cat([*own[: n + 1], *nothing[n:]], -1) for n in range(3))
    fused = interleave(
        [policy.fuse_norm(o + policy.fuse(k)) for o, k in zip(own, known, strict=True)]
    )
    block, plain = policy.attention, nn.MultiheadAttention(16, 2, batch_first=True)
    plain.in_proj_weight.data = torch.cat([block.query.weight, block.key_value.weight])
    plain.in_proj_bias.data = torch.cat([block.query.bias, block.key_value.bias])
    plain.out_proj.load_state_dict(block.out.state_dict())
    normed, later = block.norm(fused), torch.ones(3 * K, 3 * K, dtype=torch.bool).triu(1)
    hidden = fused + plain(normed, normed, normed, attn_mask=later)[0]
    full = policy.final_norm(hidden + policy.mlp(policy.mlp_norm(hidden)))
    torch.testing.assert_close(policy.features(windows), full[:, 1::3], rtol=1e-4, atol=1e-5)


def test_supervision_draws_attention_to_the_parents() -> None:
    masses, windows = [], random_windows(VECTORS)
    for lambda_mask in (0.0, 0.1, 100.0):
        torch.manual_seed(0)
        policy = UCFPolicy(UCFConfig(**SMALL, dropout=0.0, lambda_mask=lambda_mask), VECTORS)
        trained(policy, windows, 60, 1e-2)
        attention = policy.attend(policy.normalize(windows))[1].detach().mean(1)
        config = policy.config
        parents = config.parent_window, config.parent_decay, config.parent_action
        targets = parent_targets(windows.mask, *parents)
        masses.append(float((attention * (targets > 0)).sum(-1)[windows.mask].mean()))
    assert masses[0] < masses[1] < masses[2] > 0.99
    assert (attention - targets).abs().sum(-1)[windows.mask].mean() < 0.1


@pytest.mark.parametrize(
    ("name", "dim", "official", "unused"),
    [
        # Return and state heads, and the word table.
        ("dt", 128, 727_695, (128 * 11 + 11) + (128 + 1) + 128),
        ("dc", 256, 1_858_307, 0),
        # Return and state heads, and five masked taps of 16 kernels in three blocks.
        ("lsdt", 128, 1_134_111, (128 * 11 + 11) + (128 + 1) + 3 * 16 * 5 * (64 + 1)),
    ],
)
def test_parameters_are_the_official_ones_less_the_unused(
    name: str, dim: int, official: int, unused: int
) -> None:
    kind = policy_class(name)
    policy = kind(kind.Config(dim=dim), {"state": 11, "action": 3, "items": 0})
    assert sum(p.numel() for p in policy.parameters()) == official - unused


@both_heads
@pytest.mark.parametrize(("padding", "cropped"), [((0, 2, 5), 0), ((5, 4, 3), 3)])
def test_padding_that_all_windows_share_can_be_left_out(
    sizes: dict[str, int], padding: tuple[int, ...], cropped: int
) -> None:
    policy = build("ucf", sizes)
    windows = policy.normalize(random_windows(sizes, padding))
    with torch.no_grad():
        expected = policy.last_features(windows)
        found = policy.last_features(windows.last(K - cropped))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


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
    for b, t in mask.nonzero().tolist():
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
    given = mask, window, decay, previous_action
    np.testing.assert_allclose(parent_targets(*given), naive_targets(*given), rtol=1e-6, atol=1e-7)


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
        for b, t in mask.nonzero().tolist()
        for h in range(heads)
    ]
    assert float(mask_loss(attention, targets, mask)) == pytest.approx(np.mean(rows), rel=1e-5)


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("length", [1, 5])  # one step is fewer than a convolution reaches back
def test_shifted_products_are_the_convolution(padded: bool, length: int) -> None:
    torch.manual_seed(0)
    layer = CausalDepthwise(6)
    mask = torch.arange(length) >= torch.tensor([[0], [2], [4]])
    steps = torch.randn(3, length, 6, requires_grad=True)
    weights = torch.randn(3, length, 6)

    def convolution(x: torch.Tensor) -> torch.Tensor:
        x = x.masked_fill(~mask.unsqueeze(-1), 0.0) if padded else x
        return nn.Conv1d.forward(layer, F.pad(x.transpose(1, 2), (2, 0))).transpose(1, 2)

    found, right = layer(steps, mask if padded else None), convolution(steps)
    inputs = (steps, layer.weight, layer.bias)
    torch.testing.assert_close(found, right)
    gradients = (torch.autograd.grad((out * weights).sum(), inputs) for out in (found, right))
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("length", [1, 5])
def test_each_modality_of_dc_has_its_own_convolution(length: int) -> None:
    block: Any = build("dc", VECTORS).blocks[0]  # type: ignore[index]
    tokens = torch.randn(3, 3 * length, 16, requires_grad=True)
    padded = F.pad(block.mixer_norm(tokens).mT, (5, 0))
    mixed = tokens + interleave(
        [
            F.conv1d(padded[..., first:], conv.weight, conv.bias, stride=3, groups=16).mT
            for first, conv in enumerate(block.mixers)
        ]
    )
    right = mixed + block.mlp(block.mlp_norm(mixed))
    found = block(tokens, torch.ones(3, 3 * length, 1, dtype=torch.bool))
    torch.testing.assert_close(found, right)
    inputs = (tokens, *block.mixers.parameters())
    gradients = (torch.autograd.grad(out.square().sum(), inputs) for out in (found, right))
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("p", [0.1, 0.5, 0.93])
def test_the_given_share_is_dropped_and_the_mean_stays(p: float) -> None:
    torch.manual_seed(0)
    mask = draw_mask(torch.Size((401, 999)), p)
    assert float((mask == 0).float().mean()) == pytest.approx(p, abs=0.004)
    torch.testing.assert_close(mask.max(), torch.tensor(1 / (1 - p)), rtol=1e-3, atol=0)
    # Neighbours share a draw of 64 bits, but not their fate.
    together = ((mask[:, 1:] == 0) & (mask[:, :-1] == 0)).float().mean()
    assert float(together) == pytest.approx(p**2, abs=0.004)


def test_dropout_follows_the_seed_and_rests_in_evaluation() -> None:
    layer, values, residual = Dropout(0.3), torch.randn(7, 11), torch.randn(7, 11)
    torch.manual_seed(1)
    drawn, other = layer(values), layer(values)
    assert not torch.equal(drawn, other)
    torch.manual_seed(1)
    torch.testing.assert_close(layer.add(residual, values), residual + drawn)
    torch.testing.assert_close(layer(values), other)
    layer.eval()
    assert torch.equal(layer(values), values)
    assert torch.equal(layer.add(residual, values), residual + values)


def test_attention_drops_weights_and_keeps_the_mean() -> None:
    torch.manual_seed(0)
    query, key, value = (torch.randn(3, 5, 8) for _ in range(3))
    visible = torch.ones(5, 5, dtype=torch.bool).tril().expand(3, 1, 5, 5)
    heads = (each.view(3, 5, 2, 4).transpose(1, 2) for each in (query, key, value))
    right = F.scaled_dot_product_attention(*heads, visible).transpose(1, 2).flatten(2)
    torch.testing.assert_close(attend(query, key, value, visible, 2, 0.0), right)
    drawn = torch.stack([attend(query, key, value, visible, 2, 0.3) for _ in range(4000)])
    torch.testing.assert_close(drawn.mean(0), right, rtol=0, atol=0.06)
    # The first row sees one column, whose weight is 1: dropped, or divided by 0.7.
    first = drawn[:, 0, 0, :4] / value[0, 0, :4]
    assert float((first == 0).float().mean()) == pytest.approx(0.3, abs=0.03)
    np.testing.assert_allclose(first[first != 0], 1 / 0.7, rtol=1e-3)


def test_every_layer_starts_with_xaviers_weights() -> None:
    torch.manual_seed(0)
    config = LSDTConfig(context=5, dim=64, max_timestep=100)
    modules = dict(LSDTPolicy(config, {"state": 11, "action": 3, "items": 0}).named_modules())
    layers = {n: m for n, m in modules.items() if isinstance(m, nn.Linear | nn.Embedding)}
    assert len(layers) == 5 + 3 * 10
    for name, module in layers.items():
        for weight in module.weight.chunk(3 if name.endswith("query_key_value") else 1):
            limit = (6 / sum(weight.shape)) ** 0.5
            assert weight.abs().max() <= limit, name
            # The standard deviation of U(−l, l) is l/√3; 64 weights tell it to a fifth.
            assert abs(weight.std().item() / (limit / 3**0.5) - 1) < 0.25, name
        assert isinstance(module, nn.Embedding) or not module.bias.any(), name
