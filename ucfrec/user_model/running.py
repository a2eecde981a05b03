"""Running rates: how often the items of a store were shown, and how rewarded, until a time.

Where items come and go, an item is judged by what it earned so far: its effect in a model of all
rows would be unknown for items that are new, and known too well for those before.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Float64Array
from ucfrec.episodes.item_table import ALWAYS
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.store import EpisodeStore

_HOUR_MS = 3_600_000
HALF_LIVES = (6.0, 24.0, 96.0, math.inf)
"""Hours after which a row counts half, one rate each."""
HALF_LIVES_OF_DEMAND = (6.0, 24.0, 96.0, 384.0, 1536.0, 6144.0, math.inf)
"""Hours, as above, of shares that are mixed."""
AGES = 2
"""Inputs of an item's age: in days, and the logarithm of its hours and 1."""
_PRIOR = 20.0
"""Rows with the mean reward that are added to those of an item."""
_ENTRIES = 2**24
"""Most rates that are kept."""
_ROUNDS = 100
_NO_DRIFT = 100.0
"""Held-out steps that are added to those that speak for all steps alike."""
_STEADY = 0.9
"""Weight of all steps alike from which on demand counts as steady."""
_OLDEST = 30.0
"""Days from which on an item is as old as any."""


class TimeBins(NamedTuple):
    """T = `number` bins of time, the first from `begin` on, of `width` ms each."""

    begin: int
    width: int
    number: int

    @classmethod
    def of(cls, view: EpisodeStore, numbers: int) -> "TimeBins":
        """Bins of the steps of a view, of an hour or more, that have `numbers` numbers each."""
        times = view.column(schema.TIMESTAMP)
        begin, span = int(times.min()), int(times.max() - times.min()) + 1
        number = min(max(1, _ENTRIES // numbers - 1), -(-span // _HOUR_MS))
        return cls(begin, -(-span // number), number)

    def rows(self, times: Tensor) -> Tensor:
        """Rows (...), 0 to T, of what `decay` returns, that were known at times (...), ms."""
        return ((times - self.begin) // self.width).clamp(0, self.number)

    def sum(self, view: EpisodeStore, weights: Float64Array | None = None) -> Float64Array:
        """(T, n_items) sums by bin and item of the weights (N,) of the steps; None counts them."""
        n_items = len(view.item_states.embeddings)
        bins = (view.column(schema.TIMESTAMP) - self.begin) // self.width
        places = bins * n_items + view.column(schema.ITEM)
        sums = np.bincount(places, weights, self.number * n_items)
        return sums.astype(np.float64).reshape(self.number, n_items)

    def decay(self, sums: Float64Array, hours: float) -> Float64Array:
        """Of sums (T, n) by bin, those (T + 1, n) until the begin of each bin, and after the last,
        where what is `hours` old counts half."""
        factor = 0.5 ** (self.width / _HOUR_MS / hours)
        totals = np.zeros((len(sums) + 1, sums.shape[1]))
        for number, values in enumerate(sums):
            totals[number + 1] = factor * totals[number] + values
        return totals


@dataclass(frozen=True)
class RunningRates:
    """Rates of items at the begin of each of T bins of time, and after the last."""

    bins: TimeBins
    rates: Tensor
    """(T + 1, H, n_items) float32: by how much the log-odds of a reward, or the mean of
    standardised rewards, exceeds that of all rows, for each of the half-lives."""

    @classmethod
    def of(cls, store: EpisodeStore, target: Callable[[Tensor], Tensor]) -> "RunningRates | None":
        """The rates of all rows of a store, those at a time of rows in earlier bins, whose rewards
        (N,) `target` turns into what is predicted; None if its items are always available."""
        if not store.has_offers:
            return None
        view = store.whole
        bins = TimeBins.of(view, len(HALF_LIVES) * len(view.item_states.embeddings))
        earned = target(torch.from_numpy(view.column(schema.REWARD))).double().numpy()
        counts, sums = bins.sum(view), bins.sum(view, earned - earned.mean())
        decayed = [(bins.decay(sums, hours), bins.decay(counts, hours)) for hours in HALF_LIVES]
        rates = np.stack([total / (count + _PRIOR) for total, count in decayed], axis=1)
        return cls(bins, torch.from_numpy(rates).float())

    def inputs(self, offer: Offer, items: Tensor) -> Tensor:
        """(M, H + `AGES`) rates and ages of one item (M,) each, at the times of the decisions."""
        ages = _ages(offer.times, offer.offers.begin[items])
        return torch.cat([self.rates[self.bins.rows(offer.times), :, items], ages], dim=1)

    def sum_all(self, offer: Offer, weights: Tensor) -> Tensor:
        """(M, n_items) the inputs of all items times `weights` (H + `AGES`,)."""
        ages = _ages(offer.times.unsqueeze(1), offer.offers.begin) @ weights[-AGES:]
        if not self.bins.number:  # also in graphs that are exported
            return torch.einsum("thn,h->tn", self.rates, weights[:-AGES]) + ages
        distinct, rows = torch.unique(self.bins.rows(offer.times), return_inverse=True)
        return torch.einsum("thn,h->tn", self.rates[distinct], weights[:-AGES])[rows] + ages


@dataclass(frozen=True)
class Demand:
    """How often items are shown of late: a mixture of shares in which older steps count less."""

    bins: TimeBins
    mixture: Tensor
    """(H,) float32 weights of the `HALF_LIVES_OF_DEMAND`."""
    logs: Tensor
    """(T + 1, n_items) float32 logs of the shares at the begin of each bin, and after the last."""

    @staticmethod
    def of(train: EpisodeStore, held_out: EpisodeStore | None, mixture: Tensor) -> "Demand | None":
        """The demand for items of training steps, with the mixture under which those of held-out
        steps are likeliest; without these, with the given one. None if all steps count alike."""
        bins = TimeBins.of(train, len(train.item_states.embeddings))
        counts, later = bins.sum(train), np.zeros(0)

        def shares(hours: float) -> Float64Array:
            totals = bins.decay(counts, hours)
            totals += 1.0 if math.isinf(hours) else 1 / totals.shape[1]
            totals /= totals.sum(1, keepdims=True)
            return totals

        if held_out is not None:
            later = np.where(counts.any(0), held_out.item_counts(), 0.0)
        if later.any():
            last = np.stack([shares(hours)[-1] for hours in HALF_LIVES_OF_DEMAND])
            weights = fit_mixture(last, later)
            if weights[-1] < _STEADY:
                mixture = torch.from_numpy(weights).float()
        if mixture[-1] == 1:
            return None
        weighted = zip(mixture.tolist(), HALF_LIVES_OF_DEMAND, strict=True)
        mixed = sum(weight * shares(hours) for weight, hours in weighted if weight)
        return Demand(bins, mixture, torch.from_numpy(np.log(mixed)).float())


def fit_mixture(shares: Float64Array, later: Float64Array) -> Float64Array:
    """The weights (H,) of shares (H, n_items) of items under which `later` counts (n_items,) are
    likeliest, but for some held-out steps that speak for the last ones."""
    weights = np.full((len(shares), 1), 1 / len(shares))
    for _ in range(_ROUNDS):  # of expectation maximisation
        parts = weights * shares
        steps = (parts / parts.sum(0) * later).sum(1, keepdims=True)
        steps[-1] += _NO_DRIFT
        weights = steps / steps.sum()
    return weights[:, 0]


def _ages(times: Tensor, begin: Tensor) -> Tensor:
    """(..., `AGES`) of items at times (...), which are available from `begin` (...), in ms."""
    days = ((times - begin) / (24 * _HOUR_MS)).clamp(0.0, _OLDEST).float()
    days = torch.where(begin == ALWAYS[0], 0.0, days)
    return torch.stack([days, torch.log1p(24 * days)], dim=-1)
