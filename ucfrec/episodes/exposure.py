"""Terms added to the logits of items that resemble what a session was shown lately."""

from typing import Any, Final, cast

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.arrays import Float32Array, Float64Array
from ucfrec.episodes.offers import columns_of
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed

GAIN = 10.0
"""Factor on the learned weights: thousands of small updates must be able to rule an item out."""
_DENSE = 2**24
"""Entries of the largest matrix of items and tags that is kept dense, which is faster."""
_NEIGHBOURS: Final = ("lower", "higher")
_FEW_TAGS = 256
"""Tags up to which a dense matrix of the tags of some items is faster than a sparse one."""


class Likeness(nn.Module):
    """How alike two items are: the number of tags that they share, or without tags their cosine.

    Tags are kept as numbers per item and multiplied as a sparse matrix, so a catalogue with many
    tags costs no dense row per item.
    """

    tags: Tensor
    n_tags: Tensor
    directions: Tensor

    def __init__(
        self,
        n_items: int,
        embedding_size: int,
        tags_per_item: int,
    ) -> None:
        super().__init__()
        self.register_buffer("tags", torch.full((n_items, tags_per_item), -1))
        self.register_buffer("n_tags", torch.zeros((), dtype=torch.int64))
        size = 0 if tags_per_item else embedding_size
        self.register_buffer("directions", torch.zeros(n_items, size))
        self._forget()

    def _forget(self) -> None:
        """Clear what was computed from the tags."""
        self._matrix: Tensor | None = None
        self._n_tags: int | None = None
        self._sets: tuple[Tensor, Tensor] | None = None

    @classmethod
    def of(cls, states: ItemStates) -> "Likeness":
        """The likeness of the items of a store."""
        items, size = states.embeddings.shape
        likeness = cls(items, size, states.tags.shape[1])
        likeness.start_from(states)
        return likeness

    def start_from(self, states: ItemStates) -> None:
        """Set the tags, or the directions of the embeddings, of the items."""
        if self.tags.shape[1]:
            self.tags.copy_(states.tags)
            self.n_tags.fill_(int(states.tags.max()) + 1)
        else:
            self.directions.copy_(nn.functional.normalize(states.embeddings, dim=1))
        self._forget()

    def _load_from_state_dict(self, *arguments: Any, **options: Any) -> None:
        super()._load_from_state_dict(*arguments, **options)
        self._forget()

    def _count(self) -> int:
        """The number of tags, read once: a graph that is exported cannot read it."""
        if self._n_tags is None:
            self._n_tags = int(self.n_tags)
        return self._n_tags

    def profile(self, items: Tensor, weights: Tensor) -> Tensor:
        """The sum (M, F), by weights (M, N), of tags or directions of items, −1 for none."""
        weights = weights.masked_fill(items < 0, 0.0)
        if not self.tags.shape[1]:
            profile = torch.einsum("mn,mnf->mf", weights, self.directions[items])
            return profile.to(weights.dtype)
        tags, padding = self.tags[items], self._count()
        places = torch.where(tags < 0, padding, tags).flatten(1)
        spread = weights.unsqueeze(-1).expand(tags.shape).flatten(1)
        # The length of a tensor would be that of one batch in a graph that is exported.
        empty = spread.new_zeros(items.shape[0], padding + 1)
        return empty.scatter_add(1, places, spread)[:, :-1]

    def added_to(
        self,
        values: Tensor,
        profile: Tensor,
        items: Tensor | None = None,
    ) -> Tensor:
        """`values` (M, L), which are overwritten, plus the likeness to profiles (M, F) of `items`
        (L,) int64; None for all items."""
        # Scores are float32, whatever the network computes in.
        with torch.autocast(values.device.type, enabled=False):
            if not self.tags.shape[1]:
                directions = self.directions if items is None else self.directions[items]
                return values.addmm_(profile, directions.T)
            if items is None:
                matrix = self._tag_matrix()
            else:  # sparse if a product with them is then cheaper
                matrix = self._matrix_of(self.tags[items], self._count() <= _FEW_TAGS)
            if matrix.is_sparse:
                return values.add_(cast("Tensor", torch.sparse.mm(matrix, profile.T)).T)
            return values.addmm_(profile, matrix.T)

    def to_items(self, profile: Tensor, items: Tensor) -> Tensor:
        """Likeness (M,) to profiles (M, F) of one item each, (M, 1)."""
        if not self.tags.shape[1]:
            return (profile * self.directions[items[:, 0]]).sum(1)
        return self.to_candidates(profile, items)[:, 0]

    def to_candidates(self, profile: Tensor, items: Tensor) -> Tensor:
        """Likeness (M, C) to profiles (M, F) of items (M, C); to (M, L, F) it is (M, L, C)."""
        if profile.dim() == 2:
            return self.to_candidates(profile.unsqueeze(1), items).squeeze(1)
        shape = *profile.shape[:2], items.shape[1]
        if not self.tags.shape[1]:
            every = self.directions[items].unsqueeze(1).expand(-1, shape[1], -1, -1)
            flat = torch.einsum("mf,mcf->mc", profile.flatten(0, 1), every.flatten(0, 1))
            return flat.view(shape)
        tags = self.tags[items]
        places = torch.where(tags < 0, self._count(), tags).flatten(1).unsqueeze(1)
        gathered = nn.functional.pad(profile, (0, 1)).gather(
            2,
            places.expand(-1, shape[1], -1),
        )
        return gathered.view((*shape, tags.shape[2])).sum(3)

    def to_sets(self, profile: Tensor) -> tuple[Tensor, Tensor]:
        """Likeness (M, D) by tags to the D different sets of tags, and the set of every item: what
        `added_to` adds, faster where there are few profiles and many items of the same tags."""
        if self._sets is None:
            # Padding reads a place of its own, which is 0.
            tags = self.tags.cpu().numpy()
            places = np.where(tags < 0, self._count(), tags)
            distinct, sets = np.unique(places, axis=0, return_inverse=True)
            numbers = torch.from_numpy(sets.reshape(-1).astype(np.int32))
            self._sets = torch.from_numpy(distinct), numbers
        padded = nn.functional.pad(profile, (0, 1))
        columns = [padded.index_select(1, column) for column in self._sets[0].unbind(1)]
        return torch.stack(columns).sum(0), self._sets[1]

    def _tag_matrix(self) -> Tensor:
        """(n_items, n_tags), 1 where the item has the tag; sparse if it has many entries."""
        if self._matrix is None or self._matrix.device != self.tags.device:
            entries = len(self.tags) * self._count()
            self._matrix = self._matrix_of(self.tags, entries <= _DENSE)
        return self._matrix

    def _matrix_of(self, tags: Tensor, dense: bool) -> Tensor:
        rows, columns = torch.nonzero(tags >= 0, as_tuple=True)
        places = torch.stack([rows, tags[rows, columns]])
        ones = torch.ones_like(rows, dtype=self.directions.dtype)
        shape = len(tags), self._count()
        # Tags of a file are checked once, with all items.
        check_all = tags is self.tags
        matrix = torch.sparse_coo_tensor(places, ones, shape, check_invariants=check_all).coalesce()
        return matrix.to_dense() if dense else matrix


class ExposureTerm(nn.Module):
    """Adds to the logit of item i: Σ_n (v_n + v′_n r_n) [i = i_n] + Σ_n (w_n + w′_n r_n) l(i, i_n).

    i_n is the item shown n steps before, r_n its reward scaled to [0, 1] as in item states, and l
    the likeness of two items. Each weight is a common one plus one of its lag, both interpolated
    linearly in the return-to-go Ĝ between knots: how much a repetition costs depends on how much
    is still to come, and on how the item was received. All weights start at 0.
    """

    knots: Tensor
    reward_low: Tensor
    reward_high: Tensor

    def __init__(
        self,
        lags: int,
        knots: int,
        likeness: Likeness,
    ) -> None:
        super().__init__()
        self.likeness = likeness
        self.lags = lags
        # On the device "meta", torch would import sympy.
        self.register_buffer("knots", torch.linspace(0, 1, knots, device="cpu"))
        self.register_buffer("reward_low", torch.zeros(()))
        self.register_buffer("reward_high", torch.ones(()))
        self.common = nn.Parameter(torch.zeros(4, knots, 1))
        self.by_lag = nn.Parameter(torch.zeros(4, knots, lags))

    def start_from(self, states: ItemStates, returns: Tensor) -> None:
        """Set how alike the items are, the scale of the rewards, and the knots: quantiles of
        returns-to-go (N,), closer together the higher they are, because targets are high."""
        self.likeness.start_from(states)
        self.reward_low.fill_(states.reward_low)
        self.reward_high.fill_(states.reward_high)
        levels = 1 - torch.logspace(0, -2, len(self.knots), dtype=torch.float64)
        levels = levels.sub(levels[0]).div(levels[-1] - levels[0])
        knots = torch.from_numpy(quantiles(returns.numpy(), levels.numpy()))
        # Equal quantiles are moved apart, so that there is an interval between any two knots.
        width = float(knots[-1] - knots[0]) or 1.0
        apart = 1e-3 * width * torch.arange(len(knots), dtype=torch.float64)
        self.knots.copy_((knots + apart).float())

    def weights(self, exposed: Exposed) -> tuple[Tensor, Tensor]:
        """Weights of repetition and of likeness, (M, N) each, of the items shown."""
        table = GAIN * (self.common + self.by_lag)
        at = exposed.returns.clamp(self.knots[0], self.knots[-1])
        # ONNX has no search in a sorted list, and these are few.
        right = (self.knots < at.unsqueeze(1)).sum(1)
        right = right.clamp(1, len(self.knots) - 1)
        low, high = self.knots[right - 1], self.knots[right]
        share = ((at - low) / (high - low)).view(1, -1, 1)
        repeated, repeated_liked, alike, alike_liked = (
            table[:, right - 1] * (1 - share) + table[:, right] * share
        )
        span = self.reward_high - self.reward_low
        liked = ((exposed.rewards - self.reward_low) / span).clamp(0, 1)
        return repeated + repeated_liked * liked, alike + alike_liked * liked

    def added_to(
        self,
        logits: Tensor,
        exposed: Exposed,
        items: Tensor | None = None,
    ) -> Tensor:
        """Logits (M, L) with the term, which are overwritten, of `items` (L,) int64, ascending,
        each once; None for all items."""
        repeated, alike = self.weights(exposed)
        profile = self.likeness.profile(exposed.items, alike)
        logits = self.likeness.added_to(logits, profile, items)
        columns = exposed.items if items is None else columns_of(exposed.items, items)
        rows, lags = torch.nonzero(columns >= 0, as_tuple=True)
        return logits.index_put_((rows, columns[rows, lags]), repeated[rows, lags], True)

    def to_items(self, exposed: Exposed, items: Tensor) -> Tensor:
        """Terms (M,) added to the logits of one item each, (M, 1)."""
        repeated, alike = self.weights(exposed)
        added = self.likeness.to_items(self.likeness.profile(exposed.items, alike), items)
        return added + (repeated * (exposed.items == items)).sum(1)


def quantiles(values: Float32Array, levels: Float64Array) -> Float64Array:
    """`np.quantile` in float64 of one value or more, without a copy of all of them in float64."""
    low, high = (np.quantile(values, levels, method=way).astype(float) for way in _NEIGHBOURS)
    share = levels * (len(values) - 1) % 1
    # As numpy interpolates, from the nearer value.
    near_low, near_high = low + (high - low) * share, high - (high - low) * (1 - share)
    return np.asarray(np.where(share < 0.5, near_low, near_high))
