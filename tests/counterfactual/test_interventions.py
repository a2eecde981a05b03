"""Copies that intervene on dimensions, and overlays of several kinds of copies."""

from pathlib import Path

import numpy as np
import torch

from tests.support.causes import planted_vectors
from ucfrec.counterfactual.interventions import interventions


def test_interventions_change_the_flagged_dimensions_alone(tmp_path: Path) -> None:
    store = planted_vectors(tmp_path / "store", trajectories=20, length=30)
    train = store.split("train")
    union = train.with_overlay(interventions(train, [1, 4], seed=5))
    n = train.n_episodes
    assert union.n_episodes == 3 * n
    factual = train.windows(np.arange(n), train.lengths - 1, 30).states
    held, redrawn = (
        union.windows(np.arange(k * n, (k + 1) * n), train.lengths - 1, 30) for k in (1, 2)
    )
    rest = [0, 2, 3]
    for copy in (held, redrawn):
        assert torch.equal(copy.states[..., rest], factual[..., rest])
    assert torch.equal(held.states[:, 1:, [1, 4]], held.states[:, :-1, [1, 4]])
    assert (redrawn.states[:, 1:, 4] != redrawn.states[:, :-1, 4]).float().mean() > 0.9
    # Jointly from the marginal: every pair of values is some step's own.
    pairs = {tuple(pair) for pair in factual[..., [1, 4]].reshape(-1, 2).tolist()}
    drawn = redrawn.states[..., [1, 4]].reshape(-1, 2)
    assert all(tuple(pair) in pairs for pair in drawn.tolist())
    cut = np.corrcoef(drawn[:, 0], factual[..., 1].reshape(-1))[0, 1]
    assert abs(cut) < 0.15
    again = interventions(train, [1, 4], seed=5)
    assert union.overlay is not None
    np.testing.assert_array_equal(again.edit_state, union.overlay.edit_state)


def test_overlays_join_in_order(tmp_path: Path) -> None:
    train = planted_vectors(tmp_path / "store", trajectories=20, length=10).split("train")
    first, second = (interventions(train, [d], seed=d, copies=1) for d in (0, 3))
    union, n = train.with_overlay(first.joined(second)), train.n_episodes
    for k, alone in ((1, first), (2, second)):
        copies = np.arange(k * n, (k + 1) * n)
        there = union.windows(copies, train.lengths - 1, 10).states
        wanted = train.with_overlay(alone).windows(np.arange(n, 2 * n), train.lengths - 1, 10)
        assert torch.equal(there, wanted.states)
