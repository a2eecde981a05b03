"""The best items are those of a full sort."""

import pytest
import torch

from ucfrec.acting.best_items import best_items


@pytest.mark.parametrize("k", [1, 10, 300])
@pytest.mark.parametrize(
    ("rows", "n"), [(1, 50), (1, 1000), (3, 70_001), (1, 200_000), (40, 4_099)]
)
def test_the_best_are_found_wherever_they_lie(rows: int, n: int, k: int) -> None:
    generator = torch.Generator().manual_seed(n + k)
    k = min(k, n)
    for scores in (
        torch.randn(rows, n, generator=generator),
        torch.arange(n).float().repeat(rows, 1),  # all in the last block, and what is left over
        torch.randn(rows, n, generator=generator).masked_fill(torch.arange(n) > k, -torch.inf),
        torch.randint(3, (rows, n), generator=generator).float(),  # most are equal
    ):
        found = best_items(scores, k)
        expected = scores.sort(dim=1, descending=True).values[:, :k]
        assert torch.equal(scores.gather(1, found), expected)
        assert torch.equal(found[:, 0], scores.argmax(1))
        assert all(len(set(row)) == k for row in found.tolist())
