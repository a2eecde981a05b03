"""What was on offer: the items that a decision could show, by its time and its candidates."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import IntArray
from ucfrec.episodes.item_table import ALWAYS
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors


def _no_rows(columns: int) -> Tensor:
    return torch.zeros(columns, 0, dtype=torch.int64)


@dataclass(frozen=True)
class Offers:
    """When items are available, and the sets of candidates that decisions chose from."""

    begin: Tensor
    """(n_items,) int64 first ms of each item's first interval."""
    end: Tensor
    """(n_items,) int64 ms at which it is over."""
    later: Tensor = field(default_factory=lambda: _no_rows(3))
    """(3, R) int64 item, begin and end of further intervals, by item."""
    sets: Tensor = field(default_factory=lambda: _no_rows(2))
    """(2, C) int64 number of a set of candidates, from 0, and an item in it, ascending."""

    @classmethod
    def of(cls, n_items: int, intervals: IntArray, sets: IntArray | None = None) -> "Offers":
        """Items without an interval are always available.

        Args:
            intervals: (3, I) int64 item, begin and end, which is above the begin, in any order.
            sets: (2, C) as the field; None for none.
        """
        item, begin, end = intervals[:, np.lexsort((intervals[1], intervals[0]))]
        first = np.diff(item, prepend=-1) > 0
        bounds = [torch.full((n_items,), bound) for bound in ALWAYS]
        for values, bound in zip((begin, end), bounds, strict=True):
            bound[torch.from_numpy(item[first])] = torch.from_numpy(values[first])
        later = torch.from_numpy(np.stack([item, begin, end])[:, ~first])
        candidates = _no_rows(2) if sets is None else torch.from_numpy(sets)
        return cls(bounds[0], bounds[1], later, candidates)

    @property
    def intervals(self) -> IntArray:
        """(3, I) int64 item, begin and end of all intervals that have a bound."""
        bounded = torch.nonzero((self.begin != ALWAYS[0]) | (self.end != ALWAYS[1]))[:, 0]
        first = torch.stack([bounded, self.begin[bounded], self.end[bounded]])
        return torch.cat([first, self.later], dim=1).numpy()

    def at(self, times: Tensor, sets: Tensor | None = None) -> "Offer":
        """What was on offer in M decisions: times (M,) int64 ms, and numbers (M,) of their sets of
        candidates, −1 or None for all items."""
        return Offer(self, times, sets)

    def count_unavailable(self, items: IntArray, times: IntArray) -> int:
        """How many of the items (N,) are not available at times (N,) ms; −1 is no item."""
        listed = items >= 0
        offer = self.at(torch.from_numpy(times[listed].astype(np.int64)))
        has_item = offer.has(torch.from_numpy(items[listed].astype(np.int64)))
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
            shapes = {"begin": (n_items,), "end": (n_items,), "later": (3, None), "sets": (2, None)}
            for name, (first, *_) in shapes.items():
                tensor = tensors[name]
                if tensor.dtype != torch.int64 or len(tensor) != first:
                    raise ValueError(f"{name} is not of {n_items} items")
            for items in (offers.later[0], offers.sets[1]):
                if items.numel() and not 0 <= int(items.min()) <= int(items.max()) < n_items:
                    raise ValueError(f"it names items beyond the {n_items}")
            keys = offers.sets[0] * n_items + offers.sets[1]
            if bool((offers.later[0].diff() < 0).any()) or bool((keys.diff() <= 0).any()):
                raise ValueError("its rows are not in order")
            return offers


@dataclass(frozen=True)
class Offer:
    """What was on offer in M decisions."""

    offers: Offers
    times: Tensor
    """(M,) int64 ms."""
    sets: Tensor | None = None
    """(M,) int64 numbers of their sets of candidates, −1 for all items; None for no sets."""

    def change(self, change: Callable[[Tensor], Tensor]) -> "Offer":
        """A copy of which times and sets are changed, as those of some decisions."""
        sets = None if self.sets is None else change(self.sets)
        return Offer(self.offers, change(self.times), sets)

    def has(self, items: Tensor) -> Tensor:
        """(M,) bool, whether one item (M,) of each decision was on offer."""
        offers, times = self.offers, self.times
        offered = (offers.begin[items] <= times) & (times < offers.end[items])
        item, begin, end = offers.later
        first, last = (torch.searchsorted(item.contiguous(), items, right=r) for r in (False, True))
        for place in range(int((last - first).max()) if len(items) else 0):
            at = (first + place).clamp(max=len(item) - 1)
            offered |= (first + place < last) & (begin[at] <= times) & (times < end[at])
        if self.sets is not None:
            size = len(offers.begin)
            keys, members = self.sets * size + items, offers.sets[0] * size + offers.sets[1]
            offered &= (self.sets < 0) | torch.isin(keys, members)
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
        if self.sets is not None and bool((self.sets >= 0).any()):
            numbers, rows = torch.unique(self.sets, return_inverse=True)
            offered &= self._members(numbers, items)[rows]
        return offered

    def _members(self, numbers: Tensor, items: Tensor | None) -> Tensor:
        """(S, L) bool, whether the sets (S,) hold the items (L,) or all; −1 holds every item."""
        sets, size = self.offers.sets, len(self.offers.begin)
        width = size if items is None else len(items)
        members = (numbers < 0).unsqueeze(1).repeat(1, width)
        first, last = (
            torch.searchsorted(sets[0].contiguous(), numbers, right=r) for r in (False, True)
        )
        lengths = last - first
        rows = torch.repeat_interleave(torch.arange(len(numbers)), lengths)
        places = torch.arange(len(rows)) - (lengths.cumsum(0) - lengths - first)[rows]
        columns = sets[1][places]
        if items is not None:
            columns = columns_of(columns, items)
            rows, columns = rows[columns >= 0], columns[columns >= 0]
        members[rows, columns] = True
        return members


def columns_of(items: Tensor, among: Tensor) -> Tensor:
    """Positions of `items` (...) in `among` (L,), int64, ascending; −1 for items not in it."""
    columns = torch.searchsorted(among, items.contiguous()).clamp(max=len(among) - 1)
    return torch.where(among[columns] == items, columns, -1)
