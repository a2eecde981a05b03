"""Items drawn from a large catalogue, which stand for all of them in the loss of a batch."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Candidates:
    """Items that were drawn, and how much each stands for."""

    items: Tensor
    """(L,) int64, ascending, each once."""
    log_weights: Tensor
    """(L,) log of an item's draws over their expected number.

    Σ exp(log_weight + x) over the candidates has the expectation Σ exp(x) over all items."""


class Proposal:
    """Draws items with probability Q: half in proportion to training counts, half evenly.

    By counts alone, items that the logs hardly show but the policy likes would be drawn too rarely
    for their weight; evenly alone, popular items would (`benchmarks/LOG.md` has all three). The
    unit interval is cut into as many equal parts as there are draws, and every part has one: the
    draws of an item then deviate from their expectation by less than two.
    """

    def __init__(self, counts: Tensor) -> None:
        """
        Args:
            counts: (n_items,) training counts, above 0.
        """
        share = counts.double() / counts.double().sum()
        self.share = (share + 1 / len(counts)) / 2
        self._cumulative = self.share.cumsum(0)

    def draw(self, count: int) -> Candidates:
        """Draw `count` times, by torch's global generator."""
        cumulative, device = self._cumulative, self.share.device
        parts = torch.arange(count, device=device)
        points = (parts + torch.rand(count, device=device, dtype=torch.float64)) / count
        drawn = torch.searchsorted(cumulative, points * cumulative[-1], right=True)
        drawn = drawn.clamp(max=len(cumulative) - 1)
        items, copies = torch.unique_consecutive(drawn, return_counts=True)
        return Candidates(items, torch.log(copies / (count * self.share[items])).float())
