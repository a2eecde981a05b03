"""The scores of all items as a product of what sessions look for with one matrix of all items.

All operations can be exported to ONNX.
"""

import copy
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Float32Array
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Exposed, Sessions, Shown, Windows
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.user_model.fatigue import MainTags
from ucfrec.user_model.reward import ItemRewardModel


class Part(NamedTuple):
    """What the policy, or the reward model, adds to the scores of all items; or their sum."""

    factors: Tensor
    """(B, d) what multiplies the rows of the items' matrix."""
    repeated: Tensor
    """(B, N) what is added to the scores of the N items shown before."""
    alike: Tensor
    """(B, N) what the likeness of an item to these counts."""

    def at(self, rows: slice) -> "Part":
        """The sessions with the given numbers."""
        return Part(*(values[rows] for values in self))


def multipliers(part: Part) -> Float32Array:
    """(B, d + 1) what multiplies `Scorer.vectors`."""
    return F.pad(part.factors, (0, 1), value=1.0).numpy()


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
        likeness = [term.likeness for term in (exposure, model) if term is not None]
        self.own = (
            self._head is None
            or kind.act is not SequencePolicy.act
            or kind.act_and_features is not SequencePolicy.act_and_features
            or not all(_are_equal(likeness[0], second) for second in likeness)
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
            of_policy = sum(block.shape[1] for block in blocks)
            if self._by_direction():
                assert self._likeness is not None
                blocks.append(self._likeness.directions.cpu())
            of_likeness = sum(block.shape[1] for block in blocks)
            if self._model is not None:
                blocks += [self._model.vectors, self._model.item.unsqueeze(1)]
            return _columns(blocks), bias, (of_policy, of_likeness)

    @cached_property
    def _alike(self) -> Likeness | None:
        """How alike items are, on the CPU."""
        if self._likeness is None or self._likeness.tags.device.type == "cpu":
            return self._likeness
        return copy.deepcopy(self._likeness).cpu()

    @cached_property
    def _tags(self) -> Likeness:
        """The tags that filters read."""
        assert self._states is not None
        if self._alike is not None and torch.equal(self._alike.tags, self._states.tags):
            return self._alike
        return Likeness.of(self._states)

    @cached_property
    def _main_tags(self) -> MainTags:
        """The main tags that filters read."""
        assert self._states is not None
        return MainTags.of(self._states)

    def shown(self, recent: Shown) -> Tensor:
        """(B, N) the items that repetition and likeness refer to."""
        return _pad(recent.items, self._columns, -1)

    def policy_part(self, windows: Windows, recent: Shown) -> tuple[Tensor, Part]:
        """The policy's features (B, d) and its part, from windows with their target returns."""
        device = self._policy.state_mean.device
        normalized = self._policy.normalize(windows.to(device))
        features = self._features(normalized)
        nothing = features.new_zeros(features.shape[0], self._columns)
        part = Part(features / features.shape[-1] ** 0.5, nothing, nothing)
        if self._exposure is not None:
            exposed = Exposed(
                _pad(recent.items, self.lags, -1).to(device),
                _pad(recent.rewards, self.lags, 0).to(device),
                normalized.returns_to_go[:, -1],
            )
            repeated, alike = self._exposure.weights(exposed)
            part = part._replace(
                repeated=_pad(repeated, self._columns, 0), alike=_pad(alike, self._columns, 0)
            )
        if device.type != "cpu":
            return features.cpu(), Part(*(values.cpu() for values in part))
        return features, part

    def model_part(self, sessions: Sessions, states: Tensor) -> Part:
        """The reward model's part, in states (B, S) before the steps to decide."""
        model, recent = self._model, sessions.shown
        assert model is not None
        query = model.query(states, sessions.users, model.tastes_after(recent))
        _, repeated, alike = model.exposures(recent)
        return Part(
            F.pad(query, (0, 1), value=1.0),
            _pad(repeated, self._columns, 0),
            _pad(alike, self._columns, 0),
        )

    def _counts(self, policy: bool, rewards: bool) -> bool:
        """Whether what was shown counts."""
        return self._likeness is not None and (rewards or (policy and self._exposure is not None))

    def _by_direction(self) -> bool:
        return self._likeness is not None and not self._likeness.tags.shape[1]

    def weighted(
        self, items: Tensor, policy: Part | None, model: Part | None, reward_weight: float
    ) -> Part:
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
            assert self._alike is not None
            factors.append(self._alike.profile(items, alike))
        if model is not None:
            factors.append(reward_weight * model.factors)
        return Part(torch.cat(factors, 1) if factors else repeated[:, :0], repeated, alike)

    def scores(
        self, items: Tensor, part: Part, outputs: Tensor | None, policy: bool, rewards: bool
    ) -> Tensor:
        """(B, n_items), up to a constant per row.

        Args:
            items: (B, N) of `shown`.
            outputs: (B, n_items) of a policy that scores items in a way of its own.
            policy: whether the part has the policy's.
            rewards: whether it has the reward model's.
        """
        if not (policy or rewards):
            assert outputs is not None
            return outputs.clone()  # it may be what the policy keeps
        matrix, bias = self._rows(policy, rewards)
        scores = torch.addmm(bias if outputs is None else outputs, part.factors, matrix)
        if not self._counts(policy, rewards):
            return scores
        if self._alike is not None and not self._by_direction():
            shared, sets = self._alike.to_sets(self._alike.profile(items, part.alike))
            scores = scores.add_(shared.index_select(1, sets))
        repeated = part.repeated.masked_fill(items < 0, 0.0)
        return scores.scatter_add_(1, items.clamp(min=0), repeated)

    def added(self, items: Tensor, part: Part, candidates: Tensor, rewards: bool) -> Tensor:
        """(B, C) what scores of the policy are more than products, for candidates (B, C)."""
        added = torch.zeros(candidates.shape)
        if not self._counts(True, rewards):
            return added
        if self._alike is not None and not self._by_direction():
            profile = self._alike.profile(items, part.alike)
            added += self._alike.to_candidates(profile, candidates)
        same = candidates.unsqueeze(2) == items.unsqueeze(1)
        return added + (same * part.repeated.unsqueeze(1)).sum(2)

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
            profile = self._tags.profile(recent, torch.ones(recent.shape))
            if items is None:
                shared, sets = self._tags.to_sets(profile)
                yield (shared > 0).index_select(1, sets)
            else:
                yield self._tags.to_candidates(profile, items) > 0
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


def _are_equal(likeness: Likeness, reference: Likeness) -> bool:
    pairs = ((likeness.tags, reference.tags), (likeness.directions, reference.directions))
    return all(torch.equal(first.cpu(), second.cpu()) for first, second in pairs)


def _columns(blocks: list[Tensor]) -> Tensor:
    """(Σ d, n_items) of vectors (n_items, d) each. A product with one row reads this layout twice
    as fast as vectors one after the other."""
    # NumPy asks for large pages, which are read faster.
    sizes = [block.shape[1] for block in blocks]
    matrix = torch.from_numpy(np.empty((sum(sizes), len(blocks[0])), dtype=np.float32))
    for rows, block in zip(torch.split(matrix, sizes), blocks, strict=True):
        rows.copy_(block.T)
    return matrix


def _pad(values: Tensor, length: int, padding: int) -> Tensor:
    """The first `length` columns of values (B, N), with more columns where there are fewer."""
    missing = max(0, length - values.shape[1])
    values = values[:, :length]
    return F.pad(values, (0, missing), value=padding) if missing else values
