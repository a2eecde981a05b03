"""Running rates: how often the items of a store were shown, and how rewarded, until a time.

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
from ucfrec.arrays import Float64Array
from ucfrec.episodes.item_table import ALWAYS
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.store import EpisodeStore

_HOUR_MS = 3_600_000
HALF_LIVES = (6.0, 24.0, 96.0, math.inf)
"""Hours after which a row counts half, one rate each."""
HALF_LIVES_OF_DEMAND = (6.0, 24.0, 96.0, 384.0, 1536.0, 6144.0, math.inf)
"""Hours, as `HALF_LIVES`."""
AGES = 2
"""Inputs of an item's age: in days, and the logarithm of its hours and 1."""
_PRIOR = 20.0
"""Rows with the mean reward that are added to those of an item."""
_ENTRIES = 2**24
"""Most rates that are kept."""
_ROUNDS = 100
_OLDEST = 30.0
"""Days from which on an item is as old as any."""


@dataclass(frozen=True)
class TimeBins:
    """T bins of time."""

    begin: int
    """Of the first bin, ms."""
    width: int
    """Of a bin, ms."""
    count: int
    """T."""

    @classmethod
    def of(cls, view: EpisodeStore, numbers: int) -> "TimeBins":
        """Bins of an hour or more, of the steps of a view, for so many `numbers` each."""
        times = view.column(schema.TIMESTAMP)
        begin, span = int(times.min()), int(times.max() - times.min()) + 1
        count = min(max(1, _ENTRIES // numbers - 1), -(-span // _HOUR_MS))
        return cls(begin, -(-span // count), count)

    def rows(self, times: Tensor) -> Tensor:
        """Numbers (...) of what was known at times (...), ms: 0 to T."""
        return ((times - self.begin) // self.width).clamp(0, self.count)

    def sum(self, view: EpisodeStore, weights: Float64Array | None = None) -> Float64Array:
        """(T, n_items) sums by bin and item of the weights (N,) of the steps; None counts them."""
        n_items, shape = len(view.item_states.embeddings), (self.count, -1)
        bins = (view.column(schema.TIMESTAMP) - self.begin) // self.width
        places = bins * n_items + view.column(schema.ITEM)
        sums = np.bincount(places, weights, self.count * n_items)
        return sums.astype(np.float64).reshape(shape)

    def decay(self, sums: Float64Array, hours: float) -> Float64Array:
        """Of sums (T, n) by bin, those (T + 1, n) until the begin of each bin, and after the last,
        where what is `hours` old counts half."""
        decay, totals = (
            0.5 ** (self.width / _HOUR_MS / hours),
            np.zeros((len(sums) + 1, sums.shape[1])),
        )
        for number, values in enumerate(sums):
            totals[number + 1] = decay * totals[number] + values
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
        """The rates of all rows of a store, whose rewards (N,) `target` turns into what is
        predicted, from 0 to 1 or standardised; None if its items are always available.

        Rates at a time are of rows in earlier bins: never of the decision's own.
        """
        if not store.has_offers:
            return None
        view = store.whole
        bins = TimeBins.of(view, len(HALF_LIVES) * len(view.item_states.embeddings))
        earned = target(torch.from_numpy(view.column(schema.REWARD))).double().numpy()
        counts, sums = bins.sum(view), bins.sum(view, earned - earned.mean())
        rates = [
            bins.decay(sums, hours) / (bins.decay(counts, hours) + _PRIOR) for hours in HALF_LIVES
        ]
        return cls(bins, torch.from_numpy(np.stack(rates, axis=1)).float())

    def inputs(self, offer: Offer, items: Tensor) -> Tensor:
        """(M, H + `AGES`) rates and ages of one item (M,) each, at the times of the decisions."""
        ages = _ages(offer.times, offer.offers.begin[items])
        return torch.cat([self.rates[self.bins.rows(offer.times), :, items], ages], dim=1)

    def sum_all(self, offer: Offer, weights: Tensor) -> Tensor:
        """(M, n_items) the inputs of all items times `weights` (H + `AGES`,)."""
        distinct, rows = torch.unique(self.bins.rows(offer.times), return_inverse=True)
        of_rates = torch.einsum("thn,h->tn", self.rates[distinct], weights[:-AGES])
        ages = _ages(offer.times.unsqueeze(1), offer.offers.begin)
        return of_rates[rows] + ages @ weights[-AGES:]


@dataclass(frozen=True)
class Demand:
    """How often items are shown: a mixture of their shares of the steps until a time, in which
    older steps count less."""

    bins: TimeBins
    mixture: Tensor
    """(H,) float32 weights of the `HALF_LIVES_OF_DEMAND`."""
    logs: Tensor
    """(T + 1, n_items) float32 logarithms of the shares at the begin of each bin, and after the
    last."""

    @classmethod
    def of(cls, train: EpisodeStore, validation: EpisodeStore | None, mixture: Tensor) -> "Demand":
        """The demand for the items of training steps, with the mixture under which the items of
        validation steps are likeliest; without them, or if no training step shows these, with the
        given one."""
        bins = TimeBins.of(train, len(train.item_states.embeddings))
        counts, later = bins.sum(train), np.zeros(0)

        def shares(hours: float) -> Float64Array:
            totals = bins.decay(counts, hours)
            totals += 1.0 if math.isinf(hours) else 1 / totals.shape[1]
            totals /= totals.sum(1, keepdims=True)
            return totals

        if validation is not None:
            later = np.where(counts.any(0), validation.item_counts(), 0.0)
        if later.any():
            last = np.stack([shares(hours)[-1] for hours in HALF_LIVES_OF_DEMAND])
            weights = np.full((len(last), 1), 1 / len(last))
            for _ in range(_ROUNDS):  # of expectation maximisation
                parts = weights * last
                weights = (parts / parts.sum(0) * later / later.sum()).sum(1, keepdims=True)
            mixture = torch.from_numpy(weights[:, 0]).float()
        mixed = np.zeros((len(counts) + 1, counts.shape[1]))
        for weight, hours in zip(mixture.tolist(), HALF_LIVES_OF_DEMAND, strict=True):
            if weight:
                mixed += weight * shares(hours)
        return cls(bins, mixture, torch.from_numpy(np.log(mixed)).float())


def _ages(times: Tensor, begin: Tensor) -> Tensor:
    """(..., `AGES`) of items at times (...), which are available from `begin` (...), in ms."""
    days = ((times - begin) / (24 * _HOUR_MS)).clamp(0, _OLDEST).float()
    days = torch.where(begin == ALWAYS[0], 0.0, days)
    return torch.stack([days, torch.log1p(24 * days)], dim=-1)
