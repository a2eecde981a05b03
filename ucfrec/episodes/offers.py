"""What was on offer: the items that a decision could show at its time."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import IntArray
from ucfrec.episodes.item_table import ALWAYS
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors


@dataclass(frozen=True)
class Offers:
    """When the items of a catalogue are available."""

    begin: Tensor
    """(n_items,) int64 first ms of each item's first interval."""
    end: Tensor
    """(n_items,) int64 ms at which it is over."""
    later: Tensor
    """(3, R) int64 item, begin and end of further intervals, by item."""

    @classmethod
    def of(cls, n_items: int, intervals: IntArray) -> "Offers":
        """From intervals (3, I) int64 of items, in any order, each with its begin and end, which is
        later. Items without one are always available."""
        item, begin, end = intervals[:, np.lexsort((intervals[1], intervals[0]))]
        first = np.diff(item, prepend=-1) > 0
        bounds = [torch.full((n_items,), bound) for bound in ALWAYS]
        for values, bound in zip((begin, end), bounds, strict=True):
            bound[torch.from_numpy(item[first])] = torch.from_numpy(values[first])
        return cls(bounds[0], bounds[1], torch.from_numpy(np.stack([item, begin, end])[:, ~first]))

    @property
    def intervals(self) -> IntArray:
        """(3, I) int64 item, begin and end of all intervals that have a bound."""
        bounded = torch.nonzero((self.begin != ALWAYS[0]) | (self.end != ALWAYS[1]))[:, 0]
        first = torch.stack([bounded, self.begin[bounded], self.end[bounded]])
        return torch.cat([first, self.later], dim=1).numpy()

    def at(self, times: Tensor) -> "Offer":
        """What was on offer in M decisions, at times (M,) int64 ms."""
        return Offer(self, times)

    def count_unavailable(self, items: IntArray, times: IntArray) -> int:
        """How many of the items (N,) are not available at times (N,) ms; −1 is no item."""
        is_item = items >= 0
        offer = self.at(torch.from_numpy(times[is_item].astype(np.int64)))
        has_item = offer.has(torch.from_numpy(items[is_item].astype(np.int64)))
        return int((~has_item).sum())

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically."""
        save_tensors(path, vars(self), {})

    @classmethod
    def load(cls, path: Path, n_items: int | None = None) -> "Offers":
        """Read a file that `save` wrote; an InputError if it is missing, damaged or of a catalogue
        of another size than `n_items`, or any for None."""
        tensors, _ = load_tensors(path)
        with damage_explained(path, REMEDY):
            offers = cls(**tensors)
            n_items = len(offers.begin) if n_items is None else n_items
            sizes = {"begin": n_items, "end": n_items, "later": 3}
            for name, size in sizes.items():
                if tensors[name].dtype != torch.int64 or len(tensors[name]) != size:
                    raise ValueError(f"{name} is not of {n_items} items")
            item = offers.later[0]
            if bool((item.diff() < 0).any()) or bool(((item < 0) | (item >= n_items)).any()):
                raise ValueError("its later intervals are not those of items in order")
            return offers


@dataclass(frozen=True)
class Offer:
    """What was on offer in M decisions."""

    offers: Offers
    times: Tensor
    """(M,) int64 ms."""

    def change(self, change: Callable[[Tensor], Tensor]) -> "Offer":
        """A copy of which the times are changed, as those of some decisions."""
        return Offer(self.offers, change(self.times))

    def has(self, items: Tensor) -> Tensor:
        """(M,) bool, whether one item (M,) of each decision was on offer."""
        offers, times = self.offers, self.times
        offered = (offers.begin[items] <= times) & (times < offers.end[items])
        item, begin, end = offers.later
        first, last = (torch.searchsorted(item.contiguous(), items, right=r) for r in (False, True))
        for place in range(int((last - first).max()) if len(items) else 0):
            at = (first + place).clamp(max=len(item) - 1)
            offered |= (first + place < last) & (begin[at] <= times) & (times < end[at])
        return offered

    def mask(self, items: Tensor | None = None) -> Tensor:
        """(M, L) bool, whether `items` (L,) int64, ascending, each once, were on offer; None for
        all items."""
        offers, times = self.offers, self.times.unsqueeze(1)
        begin, end = offers.begin, offers.end
        if items is not None:
            begin, end = begin[items], end[items]
        offered = (begin <= times) & (times < end)
        item, begin, end = offers.later
        columns = item if items is None else columns_of(item, items)
        some = columns >= 0
        if bool(some.any()):
            again = (begin[some] <= times) & (times < end[some])
            counts = offered.int().index_add_(1, columns[some], again.int())
            offered = counts > 0
        return offered


def columns_of(items: Tensor, among: Tensor) -> Tensor:
    """Positions of `items` (...) in `among` (L,), int64, ascending; −1 for items not in it."""
    columns = torch.searchsorted(among, items.contiguous()).clamp(max=len(among) - 1)
    return torch.where(among[columns] == items, columns, -1)
