"""LSDT starts as its authors' code does."""

import torch
from torch import nn

from ucfrec.policies.lsdt import LSDTConfig, LSDTPolicy


def test_every_layer_starts_with_xaviers_weights() -> None:
    torch.manual_seed(0)
    config = LSDTConfig(context=5, dim=64, max_timestep=100)
    policy = LSDTPolicy(config, {"state": 11, "action": 3, "items": 0})
    seen = 0
    for name, module in policy.named_modules():
        if not isinstance(module, nn.Linear | nn.Embedding):
            continue
        parts = 3 if name.endswith("query_key_value") else 1
        for weight in module.weight.chunk(parts):
            limit = (6 / sum(weight.shape)) ** 0.5
            assert weight.abs().max() <= limit, name
            # The standard deviation of U(−l, l) is l/√3; 64 weights tell it to a fifth.
            assert abs(weight.std().item() / (limit / 3**0.5) - 1) < 0.25, name
            seen += 1
        if isinstance(module, nn.Linear):
            assert not module.bias.any(), name
    assert seen == 5 + 3 * (3 + 1 + 3 + 3 + 2)
