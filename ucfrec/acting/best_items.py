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
    maxima is all that reads every score. Among equal scores any may be chosen, but a row's first is
    `argmax`'s, so that the best item is the same however many are shown.
    """
    if k == 1:
        return scores.argmax(-1, keepdim=True)
    highest, found = _some_best(scores, k)
    tied = highest[:, 0] == highest[:, 1]
    if tied.any():
        first = scores[tied].argmax(-1, keepdim=True)
        # The first comes in front, and leaves out itself further back or else the last.
        joined = torch.cat([first, found[tied]], dim=1)
        again = (joined == first).index_fill(1, torch.tensor([0]), False)
        found[tied] = joined.gather(1, again.int().argsort(dim=1, stable=True)[:, :k])
    return found


def _some_best(scores: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The highest scores (B, k) and their numbers; any of equal scores may be the first."""
    n = scores.shape[1]
    # Both searches that follow the pass are of about the same size.
    size = max(_BLOCK, round((n / k) ** 0.5))
    blocks = n // size
    if scores.numel() < _FEW or 3 * k > blocks:
        values, numbers = scores.topk(k, dim=-1)
        return values, numbers
    maxima = scores[:, : blocks * size].view(len(scores), blocks, size).amax(-1)
    first = maxima.topk(k, dim=-1, sorted=False).indices * size
    numbers = (first.unsqueeze(-1) + torch.arange(size)).flatten(1)
    rest = torch.arange(blocks * size, n).expand(len(scores), -1)
    numbers = torch.cat([numbers, rest], dim=1)
    values, places = scores.gather(1, numbers).topk(k, dim=-1)
    return values, numbers.gather(1, places)
