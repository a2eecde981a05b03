"""What was on offer: the items that a decision could show, by its time and its candidates."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.arrays import IntArray
from ucfrec.episodes.item_table import ALWAYS
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors


@dataclass(frozen=True)
class Offers:
    """When the items of a catalogue are available, and sets of candidates to choose from."""

    begin: Tensor
    """(n_items,) int64 first ms of each item's first interval."""
    end: Tensor
    """(n_items,) int64 ms at which it is over."""
    later: Tensor
    """(3, R) int64 item, begin and end of further intervals, by item."""
    sets: Tensor
    """(2, C) int64 number of a set, from 0, and item in it, ascending."""

    @classmethod
    def of(cls, n_items: int, intervals: IntArray, sets: IntArray) -> "Offers":
        """From intervals (3, I) int64 of items, in any order, each with its begin and end, which is
        later, and `sets` as the field. Items without an interval are always available."""
        item, begin, end = intervals[:, np.lexsort((intervals[1], intervals[0]))]
        first = np.diff(item, prepend=-1) > 0
        bounds = [torch.full((n_items,), bound) for bound in ALWAYS]
        for values, bound in zip((begin, end), bounds, strict=True):
            bound[torch.from_numpy(item[first])] = torch.from_numpy(values[first])
        later = torch.from_numpy(np.stack([item, begin, end])[:, ~first])
        return cls(bounds[0], bounds[1], later, torch.from_numpy(sets))

    @property
    def intervals(self) -> IntArray:
        """(3, I) int64 item, begin and end of the intervals of items that are not always there."""
        some = (self.begin != ALWAYS[0]) | (self.end != ALWAYS[1])
        bounded = torch.nonzero(some.index_fill(0, self.later[0], True))[:, 0]
        first = torch.stack([bounded, self.begin[bounded], self.end[bounded]])
        return torch.cat([first, self.later], dim=1).numpy()

    def at(self, times: Tensor, sets: Tensor | None = None) -> "Offer":
        """What was on offer in M decisions, at times (M,) int64 ms, of their `sets` (M,) or None,
        as of `Offer`."""
        return Offer(self, times, sets)

    def count_unavailable(self, items: IntArray, times: IntArray, sets: IntArray) -> int:
        """How many of the items (N,) were not on offer at times (N,) ms or in the sets (N,), −1 for
        all items; −1 is no item."""
        columns = np.stack([items, times, sets])[:, items >= 0]
        item, time, numbers = torch.from_numpy(columns.astype(np.int64))
        return int((~self.at(time, numbers).has(item)).sum())

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically."""
        save_tensors(path, {part.name: getattr(self, part.name) for part in fields(self)}, {})

    @classmethod
    def load(cls, path: Path, n_items: int | None = None) -> "Offers":
        """Read a file that `save` wrote; an InputError if it is missing, damaged or of a catalogue
        of another size than `n_items`, or any for None."""
        tensors, _ = load_tensors(path)
        with damage_explained(path, REMEDY):
            offers = cls(**tensors)
            n_items = len(offers.begin) if n_items is None else n_items
            sizes = {"begin": n_items, "end": n_items, "later": 3, "sets": 2}
            for name, size in sizes.items():
                if tensors[name].dtype != torch.int64 or len(tensors[name]) != size:
                    raise ValueError(f"{name} is not of {n_items} items")
            for items in (offers.later[0], offers.sets[1]):
                if bool(((items < 0) | (items >= n_items)).any()):
                    raise ValueError(f"it has items beyond the {n_items}")
            unsorted = (offers.later[0].diff() < 0).any()
            if bool(unsorted | (offers.pairs.diff() <= 0).any()):
                raise ValueError("its items are not in order")
            return offers

    def digest(self) -> str:
        """SHA-256 of all numbers."""
        parts = [getattr(self, part.name).contiguous().numpy() for part in fields(self)]
        return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()

    @cached_property
    def pairs(self) -> Tensor:
        """(C,) set × n_items + item of `sets`, ascending."""
        return self.sets[0] * len(self.begin) + self.sets[1]


@dataclass(frozen=True)
class Offer:
    """What was on offer in M decisions."""

    offers: Offers
    times: Tensor
    """(M,) int64 ms."""
    sets: Tensor | None = None
    """(M,) int64 numbers of their sets of candidates, −1 for all items; None if all are −1."""

    def change(self, change: Callable[[Tensor], Tensor]) -> "Offer":
        """A copy of which times and sets are changed, as those of some decisions."""
        sets = None if self.sets is None else change(self.sets)
        return Offer(self.offers, change(self.times), sets)

    def has(self, items: Tensor) -> Tensor:
        """(M,) bool, whether one item (M,) of each decision was on offer."""
        offers, times, items = self.offers, self.times, items.contiguous()
        offered = (offers.begin[items] <= times) & (times < offers.end[items])
        item, begin, end = offers.later
        first, last = (torch.searchsorted(item.contiguous(), items, right=r) for r in (False, True))
        for place in range(int((last - first).max()) if len(items) else 0):
            at = (first + place).clamp(max=len(item) - 1)
            offered |= (first + place < last) & (begin[at] <= times) & (times < end[at])
        if self.sets is not None and len(offers.pairs):
            pairs = self.sets * len(offers.begin) + items
            offered &= (self.sets < 0) | (columns_of(pairs, offers.pairs) >= 0)
        return offered

    def mask(self, items: Tensor | None = None) -> Tensor:
        """(M, L) bool, whether `items` (L,) int64, ascending, were on offer; None for all items."""
        offers, times = self.offers, self.times.unsqueeze(1)
        begin, end = offers.begin, offers.end
        if items is not None:
            begin, end = begin[items], end[items]
        offered = (begin <= times) & (times < end)
        item, begin, end = offers.later
        if len(item):
            columns = item if items is None else columns_of(item, items)
            columns = torch.where(columns < 0, offered.shape[1], columns)
            columns = columns.expand(times.shape[0], -1)
            again = ((begin <= times) & (times < end)).int()
            counts = F.pad(offered.int(), (0, 1)).scatter_add(1, columns, again)
            offered = counts[:, :-1] > 0
        if self.sets is not None:
            numbers, rows = torch.unique(self.sets, return_inverse=True)
            offered &= self._members(numbers, items)[rows]
        return offered

    def _members(self, numbers: Tensor, items: Tensor | None) -> Tensor:
        """(S, L) bool, whether sets (S,) hold `items` (L,), None for all; −1 holds every item."""
        n_items = len(self.offers.begin)
        held = (numbers < 0).unsqueeze(1).repeat(1, n_items if items is None else len(items))
        ends = torch.stack([numbers, numbers + 1]) * n_items
        first, last = torch.searchsorted(self.offers.pairs, ends)
        rows = torch.repeat_interleave(last - first)
        # Members of each set follow each other.
        earlier = (last - first).cumsum(0) - last
        members = self.offers.sets[1][torch.arange(len(rows)) - earlier[rows]]
        columns = members if items is None else columns_of(members, items)
        held[rows[columns >= 0], columns[columns >= 0]] = True
        return held


def columns_of(items: Tensor, among: Tensor) -> Tensor:
    """Positions of `items` (...) in `among` (L,), int64, ascending; −1 for items not in it."""
    columns = torch.searchsorted(among, items.contiguous()).clamp(max=len(among) - 1)
    return torch.where(among[columns] == items, columns, -1)
