"""The file of item states is the same with and without torch."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ucfrec.episodes.item_table import write_item_table
from ucfrec.episodes.states import ItemStates


@pytest.mark.parametrize("tags", [None, np.array([[0, -1], [0, 1], [2, -1]])])
def test_both_write_the_same_bytes(tmp_path: Path, tags: np.ndarray | None) -> None:
    embeddings = np.random.default_rng(0).normal(size=(3, 2)).astype(np.float32)
    users = np.ones((4, 0), dtype=np.float32)
    write_item_table(tmp_path / "a", embeddings, users, tags, 0.0, 1.5)
    states = ItemStates(torch.from_numpy(embeddings), torch.from_numpy(users), 0.0, 1.5)
    if tags is not None:
        numbers = torch.from_numpy(tags)
        states = ItemStates(states.embeddings, states.user_features, 0.0, 1.5, tags=numbers)
    states.save(tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert ItemStates.load(tmp_path / "a").embeddings.equal(states.embeddings)
