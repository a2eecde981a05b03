"""Candidates stand for the whole catalogue: unbiased, each once, whatever the catalogue's size."""

import time

import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.policies.item_sampling import Proposal


@given(st.integers(1, 300), st.integers(1, 200), st.integers(0, 99))
def test_candidates_are_ascending_and_count_every_draw(n: int, draws: int, seed: int) -> None:
    torch.manual_seed(seed)
    proposal = Proposal(torch.rand(n) + 0.01)
    found = proposal.draw(draws)
    assert (found.items.diff() > 0).all()
    assert 0 <= found.items.min() <= found.items.max() < n
    copies = found.log_weights.exp() * draws * proposal.share[found.items]
    torch.testing.assert_close(copies, copies.round(), atol=1e-3, rtol=1e-3)
    assert round(float(copies.sum())) == draws
    # One draw in each of equal parts: fewer than two from what is expected.
    assert ((copies - draws * proposal.share[found.items]).abs() < 2).all()


def test_weighted_sums_over_candidates_are_unbiased() -> None:
    torch.manual_seed(0)
    values, proposal = torch.rand(40) ** 4, Proposal(torch.rand(40) ** 4 + 1e-3)
    found = [proposal.draw(15) for _ in range(4000)]
    sums = torch.stack([(each.log_weights.exp() * values[each.items]).sum() for each in found])
    error = float(sums.std()) / len(sums) ** 0.5
    assert abs(float(sums.mean() - values.sum())) < 4 * error


def test_rare_items_are_drawn_evenly_and_popular_ones_by_their_counts() -> None:
    counts = torch.cat([torch.ones(1000) * 1e-6, torch.tensor([3.0, 1.0])])
    share = Proposal(counts).share
    torch.testing.assert_close(share.sum(), torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(share[0] / share[1], torch.ones((), dtype=torch.float64))
    assert float(share[:1000].sum()) > 0.49
    assert 2.9 < float(share[1000] / share[1001]) < 3


def test_a_draw_costs_about_the_same_in_every_catalogue() -> None:
    small, large = Proposal(torch.rand(1000) + 0.1), Proposal(torch.rand(2_000_000) + 0.1)
    seconds = {small: 1e9, large: 1e9}
    for _ in range(10):
        for proposal in (small, large):
            start = time.thread_time()
            proposal.draw(2048)
            seconds[proposal] = min(seconds[proposal], time.thread_time() - start)
    assert seconds[large] < 20 * seconds[small]
