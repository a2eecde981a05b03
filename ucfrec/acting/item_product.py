"""The scores of all items as a product of what sessions look for with one matrix of all items.

All operations can be exported to ONNX.
"""

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.sessions import History
from ucfrec.arrays import Float32Array
from ucfrec.episodes.exposure import Exposed, Likeness, Shown
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.user_model.fatigue import MainTags
from ucfrec.user_model.reward import ItemRewardModel


class Part(NamedTuple):
    """What the policy, or the reward model, adds to the scores of all items."""

    factors: Tensor
    """(B, d) what multiplies the items' vectors."""
    repeated: Tensor
    """(B, N) what is added to the scores of items shown before."""
    alike: Tensor
    """(B, N) what the likeness of an item to these counts."""


class Factors(NamedTuple):
    """The parts of a query, weighted and added."""

    factors: Tensor
    """(B, d) what multiplies the rows of the items' matrix, the last of which is weighted most."""
    items: Tensor
    """(B, N) int64 items shown before, −1 for none."""
    repeated: Tensor
    """(B, N) what is added to the scores of these items."""
    alike: Tensor
    """(B, N) what the tags that an item shares with these count."""


def multipliers(factors: Factors) -> Float32Array:
    """(B, d + 1) what multiplies `Scorer.vectors`."""
    return F.pad(factors.factors, (0, 1), value=1.0).numpy()


class ItemProduct:
    """All items of a catalogue as a policy and a reward model see them, computed once.

    Rows of the matrix are the policy's vectors, the directions that items without tags are alike
    by, and the reward model's vectors and effects of items.
    """

    def __init__(
        self, policy: SequencePolicy, model: ItemRewardModel | None, states: ItemStates | None
    ) -> None:
        self._policy, self._model, self._states = policy, model, states
        head, kind = policy.head, type(policy)
        self._head = head if isinstance(head, ItemHead) else None
        exposure = None if self._head is None else self._head.exposure
        self.lags = 0 if exposure is None else exposure.lags
        likeness = [each.likeness for each in (exposure, model) if each is not None]
        self.own = (
            self._head is None
            or kind.act is not SequencePolicy.act
            or kind.act_and_features is not SequencePolicy.act_and_features
            or not all(_equal(likeness[0], each) for each in likeness)
        )
        """Whether the policy scores items in a way of its own."""
        self._exposure = None if self.own else exposure
        if self.own:
            likeness = [] if model is None else [model.likeness]
        self._likeness = likeness[0] if likeness else None
        self._columns = max(self.lags, 0 if model is None else model.lags)

    @property
    def count(self) -> int:
        """n_items."""
        assert self._states is not None
        return len(self._states.embeddings)

    @cached_property
    def _features(self) -> Callable[[Windows], Tensor]:
        return self._policy.acting_features()

    @cached_property
    def _matrix(self) -> tuple[Tensor, Tensor, tuple[int, int]]:
        """The matrix (d, n_items), the policy's bias (n_items,), and how many of the first rows
        are the policy's, and those or of likeness."""
        blocks, bias = list[Tensor](), torch.zeros(())
        with torch.no_grad():
            if not self.own:
                assert self._head is not None
                blocks = [(self._head.project(self._head.embeddings) + self._head.correction).cpu()]
                bias = self._head.bias.detach().cpu()
            of_policy = sum(each.shape[1] for each in blocks)
            if self._by_direction():
                assert self._likeness is not None
                blocks.append(self._likeness.directions.cpu())
            of_likeness = sum(each.shape[1] for each in blocks)
            if self._model is not None:
                blocks += [self._model.vectors, self._model.item.unsqueeze(1)]
            return _columns(blocks), bias, (of_policy, of_likeness)

    @cached_property
    def _tags(self) -> "_Tags":
        """The tags that filters read."""
        assert self._states is not None
        return _Tags(self._states.tags)

    @cached_property
    def _main_tags(self) -> MainTags:
        """The main tags that filters read."""
        assert self._states is not None
        return MainTags.of(self._states)

    @cached_property
    def _alike(self) -> "_Tags | None":
        """The tags by which items are alike; None if they are by directions."""
        if self._likeness is None or not self._likeness.tags.shape[1]:
            return None
        tags = self._likeness.tags.cpu()
        if self._states is not None and torch.equal(tags, self._states.tags):
            return self._tags
        return _Tags(tags)

    def shown(self, shown: Shown) -> Tensor:
        """(B, N) the items that repetition and likeness refer to."""
        return _padded(shown.items, self._columns, -1)

    def of_policy(self, history: History) -> tuple[Tensor, Part]:
        """The policy's features (B, d) and its part, from a history with its target."""
        device, shown = self._policy.state_mean.device, history.shown
        normalized = self._policy.normalize(history.windows.to(device))
        features = self._features(normalized)
        nothing = features.new_zeros(features.shape[0], self._columns)
        part = Part(features / features.shape[-1] ** 0.5, nothing, nothing)
        if self._exposure is not None:
            exposed = Exposed(
                _padded(shown.items, self.lags, -1).to(device),
                _padded(shown.rewards, self.lags, 0).to(device),
                normalized.returns_to_go[:, -1],
            )
            weights = (_padded(each, self._columns, 0) for each in self._exposure.weights(exposed))
            part = Part(part.factors, *weights)
        if device.type != "cpu":
            return features.cpu(), Part(*(each.cpu() for each in part))
        return features, part

    def of_model(self, history: History) -> Part:
        """The reward model's part."""
        model, shown = self._model, history.shown
        assert model is not None
        query = model.query(history.windows.states[:, -1], history.users, model.tastes_after(shown))
        factors = F.pad(query, (0, 1), value=1.0)
        weights = (_padded(each, self._columns, 0) for each in model.exposures(shown)[1:])
        return Part(factors, *weights)

    def _counts(self, policy: bool, rewards: bool) -> bool:
        """Whether what was shown counts."""
        return self._likeness is not None and (rewards or (policy and self._exposure is not None))

    def _by_direction(self) -> bool:
        return self._likeness is not None and not self._likeness.tags.shape[1]

    def factors(
        self, items: Tensor, policy: Part | None, model: Part | None, reward_weight: float
    ) -> Factors:
        """The weighted sum of the parts; without a part, the rows of its own are excluded."""
        repeated = alike = torch.zeros_like(items, dtype=torch.float32)
        factors = list[Tensor]()
        if policy is not None:
            factors.append(policy.factors)
            repeated, alike = policy.repeated, policy.alike
        if model is not None:
            repeated = repeated + reward_weight * model.repeated
            alike = alike + reward_weight * model.alike
        if self._by_direction() and self._counts(policy is not None, model is not None):
            assert self._likeness is not None
            factors.append(self._likeness.profile(items, alike))
        if model is not None:
            factors.append(reward_weight * model.factors)
        joined = torch.cat(factors, 1) if factors else repeated[:, :0]
        return Factors(joined, items, repeated, alike)

    def scores(
        self, factors: Factors, outputs: Tensor | None, policy: bool, rewards: bool
    ) -> Tensor:
        """(B, n_items), up to a constant per row.

        Args:
            outputs: (B, n_items) of a policy that scores items in a way of its own.
            policy: whether the factors have the policy's part.
            rewards: whether they have the reward model's.
        """
        if not (policy or rewards):
            assert outputs is not None
            return outputs.clone()  # it may be what the policy keeps
        matrix, bias = self._rows(policy, rewards)
        scores = torch.addmm(bias if outputs is None else outputs, factors.factors, matrix)
        if not self._counts(policy, rewards):
            return scores
        if self._alike is not None:
            scores = scores.add_(self._alike.shared(factors.items, factors.alike))
        repeated = factors.repeated.masked_fill(factors.items < 0, 0.0)
        return scores.scatter_add_(1, factors.items.clamp(min=0), repeated)

    def added(self, factors: Factors, items: Tensor, rewards: bool) -> Tensor:
        """(B, C) what the policy's scores of items (B, C), at least 0, are more than products."""
        added = torch.zeros(items.shape)
        if not self._counts(True, rewards):
            return added
        if self._alike is not None:
            added += self._alike.shared(factors.items, factors.alike, items)
        same = items.unsqueeze(2) == factors.items.unsqueeze(1)
        return added + (same * factors.repeated.unsqueeze(1)).sum(2)

    def vectors(self, rewards: bool) -> Float32Array:
        """(n_items, d + 1); the last column is the bias."""
        matrix, bias = self._rows(True, rewards)
        vectors = np.empty((len(bias), len(matrix) + 1), dtype=np.float32)
        vectors[:, :-1], vectors[:, -1] = matrix.numpy().T, bias.numpy()
        return vectors

    def without_tags(
        self, rule: DecisionRule, shown: Shown, items: Tensor | None = None
    ) -> Iterator[Tensor]:
        """What each tag filter of the rule excludes, (B, n_items) bool, or (B, C) of items."""
        if rule.tag_window:
            recent = shown.items[:, : rule.tag_window]
            yield self._tags.any_shared(recent, items)
        if rule.tag_run:
            tired = self._main_tags.tired(shown, rule.tag_run).unsqueeze(1)
            main = self._main_tags.tags
            yield ((main if items is None else main[items]) == tired) & (tired >= 0)

    def _rows(self, policy: bool, rewards: bool) -> tuple[Tensor, Tensor]:
        """The rows of the matrix that the factors multiply, and the bias."""
        matrix, bias, (of_policy, of_likeness) = self._matrix
        first = 0 if policy else of_policy
        if rewards:
            last = len(matrix)
        else:
            last = of_likeness if self._counts(policy, rewards) else of_policy
        return matrix[first:last], bias if policy else torch.zeros(())


class _Tags:
    """Sums over the tags of all items, computed once for items of the same tags."""

    def __init__(self, tags: Tensor) -> None:
        """Args:
        tags: (n_items, T) int64, −1 for none.
        """
        self._n_tags = int(tags.max()) + 1 if tags.numel() else 0
        # Padding reads a place of its own, which is 0.
        places = np.where(tags.numpy() < 0, self._n_tags, tags.numpy())
        self._places = torch.from_numpy(places)
        distinct, which = np.unique(places, axis=0, return_inverse=True)
        self._distinct = torch.from_numpy(distinct)
        self._which = torch.from_numpy(which.reshape(-1).astype(np.int32))

    def shared(self, shown: Tensor, weights: Tensor, items: Tensor | None = None) -> Tensor:
        """Weighted number of tags that items share with what was shown.

        Args:
            shown: (B, N) int64 items, −1 for none.
            weights: (B, N) of them.
            items: (B, C) int64; None for all items.

        Returns:
            (B, n_items), or (B, C).
        """
        sums = self._sums(shown, weights, items)
        return sums if items is not None else sums.index_select(1, self._which)

    def any_shared(self, shown: Tensor, items: Tensor | None = None) -> Tensor:
        """Whether items share a tag with any that was shown; arguments as of `shared`."""
        some = self._sums(shown, torch.ones_like(shown, dtype=torch.float32), items) > 0
        return some if items is not None else some.index_select(1, self._which)

    def _sums(self, shown: Tensor, weights: Tensor, items: Tensor | None) -> Tensor:
        """`shared` of items (B, C), or for all items (B, M), of the M different sets of tags."""
        weights = weights.masked_fill(shown < 0, 0.0)
        places = self._places[shown.clamp(min=0)]  # (B, N, T)
        spread = weights.unsqueeze(-1).expand(places.shape).flatten(1)
        empty = spread.new_zeros(shown.shape[0], self._n_tags + 1)
        profile = empty.scatter_add(1, places.flatten(1), spread)
        profile = F.pad(profile[:, :-1], (0, 1))
        if items is not None:
            tags = self._places[items]  # (B, C, T)
            return profile.gather(1, tags.flatten(1)).view(tags.shape).sum(2)
        columns = [profile.index_select(1, column) for column in self._distinct.unbind(1)]
        return torch.stack(columns).sum(0)


def _equal(one: Likeness, other: Likeness) -> bool:
    pairs = ((one.tags, other.tags), (one.directions, other.directions))
    return all(torch.equal(first.cpu(), second.cpu()) for first, second in pairs)


def _columns(blocks: list[Tensor]) -> Tensor:
    """(Σ d, n_items) of vectors (n_items, d) each. A product with one row reads this layout twice
    as fast as vectors one after the other."""
    # NumPy asks for large pages, which are read faster.
    sizes = [each.shape[1] for each in blocks]
    matrix = torch.from_numpy(np.empty((sum(sizes), len(blocks[0])), dtype=np.float32))
    for part, each in zip(torch.split(matrix, sizes), blocks, strict=True):
        part.copy_(each.T)
    return matrix


def _padded(values: Tensor, length: int, padding: int) -> Tensor:
    """The first `length` columns of values (B, N), with more columns where there are fewer."""
    missing = max(0, length - values.shape[1])
    values = values[:, :length]
    return F.pad(values, (0, missing), value=padding) if missing else values
