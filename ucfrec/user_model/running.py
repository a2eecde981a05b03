"""Running rates: how the items of a store were rewarded until a time.

Where items come and go, an item is judged by what it earned so far: its effect in a model of all
rows would be unknown for items that are new, and known too well for those before.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.item_table import ALWAYS
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.store import EpisodeStore

_HOUR_MS = 3_600_000
HALF_LIVES = (6.0, 24.0, 96.0, math.inf)
"""Hours after which a row counts half, one rate each."""
AGES = 2
"""Inputs of an item's age: in days, and the logarithm of its hours and 1."""
_PRIOR = 20.0
"""Rows with the mean reward that are added to those of an item."""
_ENTRIES = 2**24
"""Most rates that are kept."""
_OLDEST = 30.0
"""Days from which on an item is as old as any."""


@dataclass(frozen=True)
class RunningRates:
    """Rates of items at the begin of each of T bins of time, and after the last."""

    begin: int
    """Of the first bin, ms."""
    width: int
    """Of a bin, ms."""
    rates: Tensor
    """(T + 1, H, n_items) float32: by how much the log-odds of a reward, or the mean of
    standardised rewards, exceeds that of all rows, for each of the half-lives."""

    @classmethod
    def of(cls, store: EpisodeStore, target: Callable[[Tensor], Tensor]) -> "RunningRates | None":
        """The rates of all rows of a store, whose rewards (N,) `target` turns into what is
        predicted, from 0 to 1 or standardised; None if its items are always available.

        Rates at a time are of rows in earlier bins: never of the decision's own.
        """
        if not store.has_offers:
            return None
        view, n_items = store.whole, len(store.item_states.embeddings)
        items, times, rewards = (
            view.column(name) for name in (schema.ITEM, schema.TIMESTAMP, schema.REWARD)
        )
        earned = target(torch.from_numpy(rewards)).double().numpy()
        begin, span = int(times.min()), int(times.max() - times.min()) + 1
        most = max(1, _ENTRIES // (n_items * len(HALF_LIVES)) - 1)
        bins = min(most, -(-span // _HOUR_MS))
        width = -(-span // bins)
        places = (times - begin) // width * n_items + items
        shape = bins, n_items
        counts, sums = (
            np.bincount(places, weights, bins * n_items).reshape(shape)
            for weights in (None, earned - earned.mean())
        )
        rates = np.zeros((bins + 1, len(HALF_LIVES), n_items), dtype=np.float32)
        for number, hours in enumerate(HALF_LIVES):
            decay, count, total = 0.5 ** (width / _HOUR_MS / hours), np.zeros(n_items), 0.0
            for place in range(bins):
                count, total = decay * count + counts[place], decay * total + sums[place]
                rates[place + 1, number] = total / (count + _PRIOR)
        return cls(begin, width, torch.from_numpy(rates))

    def rows(self, times: Tensor) -> Tensor:
        """Numbers (M,) of the rates that were known at times (M,), ms."""
        return ((times - self.begin) // self.width).clamp(0, len(self.rates) - 1)

    def inputs(self, offer: Offer, items: Tensor) -> Tensor:
        """(M, H + `AGES`) rates and ages of one item (M,) each, at the times of the decisions."""
        ages = _ages(offer.times, offer.offers.begin[items])
        return torch.cat([self.rates[self.rows(offer.times), :, items], ages], dim=1)

    def sum_all(self, offer: Offer, weights: Tensor) -> Tensor:
        """(M, n_items) the inputs of all items times `weights` (H + `AGES`,)."""
        distinct, rows = torch.unique(self.rows(offer.times), return_inverse=True)
        of_rates = torch.einsum("thn,h->tn", self.rates[distinct], weights[:-AGES])
        ages = _ages(offer.times.unsqueeze(1), offer.offers.begin)
        return of_rates[rows] + ages @ weights[-AGES:]


def _ages(times: Tensor, begin: Tensor) -> Tensor:
    """(..., `AGES`) of items at times (...), which are available from `begin` (...), in ms."""
    days = ((times - begin) / (24 * _HOUR_MS)).clamp(0, _OLDEST).float()
    days = torch.where(begin == ALWAYS[0], 0.0, days)
    return torch.stack([days, torch.log1p(24 * days)], dim=-1)
