"""Clusters of states, and the actions logged in each."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.counterfactual.clusters import ActionSupport, StateClusters


def test_states_apart_are_clusters_apart() -> None:
    centres = torch.tensor([[8.0, 0.0], [-8.0, 0.0], [0.0, 8.0]])
    labels = torch.arange(300) % 3
    spread = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])[labels]
    noise = torch.randn(300, 2, generator=torch.Generator().manual_seed(0))
    clusters = StateClusters.of(centres[labels] + spread * noise, 3, seed=0)
    found = clusters.nearest(centres)
    assert sorted(found.tolist()) == [0, 1, 2]
    torch.testing.assert_close(clusters.centres[found], centres, atol=0.3, rtol=0)
    wide = clusters.covariances[found].diagonal(dim1=1, dim2=2)
    assert wide[0, 0] > 2 * wide[0, 1] - 1
    assert wide[0, 0] > wide[1, 0]
    assert len(StateClusters.of(centres, 32, seed=0).centres) == 1


@given(
    labels=st.lists(st.integers(0, 4), min_size=1, max_size=30),
    asked=st.lists(st.integers(0, 6), max_size=30),
    size=st.sampled_from([None, 2]),
    seed=st.integers(0, 9),
)
def test_only_actions_of_the_same_cluster_are_drawn(
    labels: list[int], asked: list[int], size: int | None, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    numbers = rng.permutation(len(labels))
    actions = numbers if size is None else np.stack([numbers, -numbers], axis=1).astype(np.float32)
    support = ActionSupport(np.array(labels), actions)
    drawn, known = support.draw(np.array(asked, dtype=np.int64), rng)
    assert known.tolist() == [label in labels for label in asked]
    cluster_of = dict(zip(numbers.tolist(), labels, strict=True))
    for action, label, is_known in zip(drawn, asked, known, strict=True):
        if is_known:
            first = int(np.atleast_1d(action)[0])
            assert cluster_of[first] == label
            assert size is None or action.tolist() == [first, -first]


def test_actions_are_drawn_as_often_as_they_were_logged() -> None:
    support = ActionSupport(np.zeros(8, dtype=np.int64), np.array([3, 3, 3, 3, 3, 3, 5, 9]))
    drawn, _ = support.draw(np.zeros(40_000, dtype=np.int64), np.random.default_rng(0))
    shares = np.bincount(drawn, minlength=10) / 40_000
    np.testing.assert_allclose(shares[[3, 5, 9]], [0.75, 0.125, 0.125], atol=0.01)
