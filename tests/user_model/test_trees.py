"""Boosted trees as tensors."""

import numpy as np
import torch

from ucfrec.user_model.trees import BoostedTrees


def test_another_value_of_one_input_is_as_if_it_were_there() -> None:
    rng = np.random.default_rng(0)
    inputs = rng.integers(4, size=(2000, 3)).astype(np.float64)
    trees = BoostedTrees.fit(inputs, (inputs.sum(1) + rng.normal(size=2000)) > 5, 0)
    given, other = torch.from_numpy(inputs), torch.from_numpy(rng.integers(4, size=2000))
    for number in range(3):
        changed = given.clone()
        changed[:, number] = other
        odds = trees.with_values(given, number, [other, given[:, number]])
        assert torch.equal(odds[0], trees(changed))
        assert torch.equal(odds[1], trees(given))
        assert not torch.equal(*odds)
