"""The best items of many, exactly."""

from typing import Final

import torch
from torch import Tensor

_FEW: Final = 2**16
"""Scores up to which looking for blocks first costs more."""
_BLOCK: Final = 128
"""Items of the smallest block; maxima of fewer cost more."""


def best_items(scores: Tensor, k: int) -> Tensor:
    """Numbers (B, k) of the k highest scores (B, n), best first; k at most n.

    The k best of all lie in the k blocks of items with the highest maxima, so a pass that finds the
    maxima is all that reads every score. Among equal scores any may be chosen.
    """
    n = scores.shape[1]
    # Both searches that follow the pass are of about the same size.
    size = max(_BLOCK, round((n / k) ** 0.5))
    blocks = n // size
    if scores.numel() < _FEW or 3 * k > blocks:
        return scores.topk(k, dim=-1).indices
    maxima = scores[:, : blocks * size].view(len(scores), blocks, size).amax(-1)
    first = maxima.topk(k, dim=-1, sorted=False).indices * size
    numbers = (first.unsqueeze(-1) + torch.arange(size)).flatten(1)
    rest = torch.arange(blocks * size, n).expand(len(scores), -1)
    numbers = torch.cat([numbers, rest], dim=1)
    return numbers.gather(1, scores.gather(1, numbers).topk(k, dim=-1).indices)
