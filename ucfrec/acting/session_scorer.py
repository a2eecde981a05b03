"""`Decider.scores` of running sessions, with all that depends on the model alone kept ready."""

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.acting.decision import Decider
from ucfrec.acting.sessions import Sessions
from ucfrec.arrays import Float32Array
from ucfrec.episodes.exposure import Exposed, Likeness, Shown
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.user_model.reward import ItemRewardModel


class Query(NamedTuple):
    """What B sessions ask of all items."""

    factors: Tensor
    """(B, d) what multiplies the items' vectors."""
    items: Tensor
    """(B, N) int64 items shown before, −1 for none."""
    repeated: Tensor
    """(B, N) what is added to the scores of these items."""
    alike: Tensor
    """(B, N) what their likeness to an item counts."""


class SessionScorer:
    """Scores items for sessions as `Decider.scores` does, equal up to rounding.

    The policy's item vectors and those of the reward model are one matrix, so that a single product
    gives both. Policies that score items in a way of their own are asked as before.
    """

    def __init__(self, decider: Decider, states: ItemStates) -> None:
        """
        Args:
            decider: a policy of items under its rule; its weights must not change afterwards.
            states: of the run.
        """
        self._decider, self._states = decider, states
        self.context = decider.policy.config.context
        """Most steps that the policy sees."""
        self.length = max(self.context - 1 + states.window, decider.reach)
        """Items of a session that are read."""
        self._product = _Product.of(decider)
        self._of_one: Callable[[Sessions], Query] | None = None

    @property
    def modules(self) -> list[nn.Module]:
        """What `query` computes with."""
        models = (self._decider.policy, self._decider.reward_model)
        return [each for each in models if each is not None]

    @property
    def observation_size(self) -> int:
        """Numbers of a logged observation, which end a state."""
        return self._decider.policy.state_mean.shape[0] - self._states.size

    @property
    def n_items(self) -> int:
        """Items of the catalogue."""
        return len(self._states.embeddings)

    @property
    def n_users(self) -> int:
        """Users of the training logs."""
        return len(self._states.user_features)

    @property
    def has_query(self) -> bool:
        """Whether the policy scores items by a product with their vectors."""
        return self._product is not None

    @torch.no_grad()
    def query(self, sessions: Sessions, context: int | None = None) -> Query:
        """What the sessions ask of all items: all of the scores that does not grow with them.

        Args:
            sessions: of at least `length` items each.
            context: steps that the policy sees; None for all that it can.
        """
        assert self._product is not None
        windows = sessions.windows(self._states, context or self.context)
        return self._product.query(self._decider.asked(windows, sessions.collected), sessions)

    def vectors(self) -> Float32Array:
        """(n_items, d + 1) vectors of all items, whose products with `asked` are most of the
        scores."""
        assert self._product is not None
        return self._product.vectors()

    @torch.inference_mode()
    def asked(self, query: Query) -> Float32Array:
        """(B, d + 1) what multiplies `vectors`."""
        assert self._product is not None
        return self._product.asked(query)

    @torch.inference_mode()
    def of_items(self, sessions: Sessions, query: Query, items: Tensor, products: Tensor) -> Tensor:
        """Scores (B, C) of some items; −∞ for those that the rule's tags leave out, even if no
        others remain.

        Args:
            sessions: as for `scores`.
            query: of the sessions.
            items: (B, C) int64.
            products: (B, C) of `asked` and the items' `vectors`.
        """
        assert self._product is not None
        scores = products + self._product.added(query, items)
        return scores.masked_fill_(_tags_left_out(self._decider, sessions.shown, items), -torch.inf)

    def answering_one_with(self, query: "Callable[[Sessions], Query]") -> "SessionScorer":
        """The same, but the query of a single session is computed by `query`."""
        other = copy.copy(self)
        other._of_one = query
        return other

    def scores(
        self,
        sessions: Sessions,
        left_out: tuple[Tensor, Tensor] | None = None,
        excluded: Tensor | None = None,
    ) -> Tensor:
        """(B, n_items) log π(i | s, Ĝ) + β f̂_r(s, i), up to a constant per row; −∞ for items left
        out, which may be all of a row.

        Args:
            sessions: of at least `length` items each.
            left_out: rows (N,) and items (N,) of what may not be recommended.
            excluded: (B, n_items) or (n_items,) bool, what may not be recommended.

        Raises:
            InputError: the scores of some row are NaN.
        """
        # Learners may keep tensors, which those of inference mode would spoil for training.
        mode = torch.no_grad() if self._product is None else torch.inference_mode()
        with mode:
            scores = self._scores(sessions)
            if left_out is not None:
                scores[left_out] = -torch.inf
            if excluded is not None:
                scores = scores.masked_fill_(excluded, -torch.inf)
            scores = self._decider.without_recent_tags(scores, sessions.shown)
            return self._decider.without_tired_tags(scores, sessions.shown)

    def _scores(self, sessions: Sessions) -> Tensor:
        decider = self._decider
        # No learner's outputs depend on how much padding is before a session.
        context = min(self.context, int(sessions.steps.max()) + 1)
        if self._product is None:
            windows = decider.asked(sessions.windows(self._states, context), sessions.collected)
            # Learners may give what they keep, and scores are overwritten.
            outputs = decider.act_and_features(windows)[0].clone()
            scores = decider.weighted(outputs, windows, sessions.users, sessions.shown)
        else:
            if self._of_one is not None and len(sessions.users) == 1:
                query = self._of_one(sessions)
            else:
                query = self.query(sessions, context)
            scores = self._product.scores(query)
        decider.require_numbers(scores)
        return scores


class _Product:
    """Scores as a product of features with one matrix of all items, plus what was shown."""

    def __init__(self, decider: Decider, head: ItemHead, model: ItemRewardModel | None) -> None:
        self._policy, self._reward_weight, self._model = (
            decider.policy,
            decider.rule.reward_weight,
            model,
        )
        self._features = decider.policy.acting_features()
        self._exposure = head.exposure
        likeness = _likenesses(head, model)
        factors = [head.project(head.embeddings) + head.correction]
        self._bias = head.bias.detach()
        if model is not None:
            factors.append(model.vectors)
            self._bias = self._bias + self._reward_weight * model.item
        self._alike = None
        self._likeness = likeness[0] if likeness else None
        if self._likeness is not None:
            if self._likeness.tags.shape[1]:
                self._alike = _TagSums(self._likeness)
            else:
                factors.append(self._likeness.directions)
        self._matrix = _columns(factors)

    @classmethod
    def of(cls, decider: Decider) -> "_Product | None":
        """None for a policy that scores items in a way of its own."""
        policy, model = decider.policy, decider.reward_model if decider.rule.reward_weight else None
        kind, head = type(policy), policy.head
        own = kind.act is SequencePolicy.act
        own = own and kind.act_and_features is SequencePolicy.act_and_features
        if not own or not isinstance(head, ItemHead):
            return None
        first, *others = *_likenesses(head, model), None
        alike = all(other is None or _equal(first, other) for other in others)
        with torch.no_grad():
            return cls(decider, head, model) if alike else None

    def scores(self, query: Query) -> Tensor:
        """(B, n_items), up to a constant per row."""
        factors, profile = self._asked(query)
        scores = torch.addmm(self._bias, factors, self._matrix)
        if profile is not None:
            assert self._alike is not None
            scores.add_(self._alike.of(profile))
        if self._likeness is None:
            return scores
        rows, lags = torch.nonzero(query.items >= 0, as_tuple=True)
        repeated = query.repeated[rows, lags]
        return scores.index_put_((rows, query.items[rows, lags]), repeated, accumulate=True)

    def vectors(self) -> Float32Array:
        """(n_items, d + 1) what `asked` is multiplied with; the last column is the bias."""
        vectors = np.empty((len(self._bias), len(self._matrix) + 1), dtype=np.float32)
        vectors[:, :-1], vectors[:, -1] = self._matrix.numpy().T, self._bias.numpy()
        return vectors

    def asked(self, query: Query) -> Float32Array:
        """(B, d + 1) what multiplies the vectors of all items."""
        return F.pad(self._asked(query)[0], (0, 1), value=1.0).numpy()

    def added(self, query: Query, items: Tensor) -> Tensor:
        """(B, C) what the scores of items (B, C), at least 0, are more than the products."""
        profile = self._asked(query)[1]
        added = torch.zeros(items.shape)
        if profile is not None:
            assert self._alike is not None
            added += self._alike.of_items(profile, items)
        if self._likeness is not None:
            same = items.unsqueeze(2) == query.items.unsqueeze(1)
            added += (same * query.repeated.unsqueeze(1)).sum(2)
        return added

    def _asked(self, query: Query) -> tuple[Tensor, Tensor | None]:
        """What multiplies the matrix, and the profile of tags that counts besides."""
        if self._likeness is None:
            return query.factors, None
        profile = self._likeness.profile(query.items, query.alike)
        if self._alike is None:
            return torch.cat([query.factors, profile], 1), None
        return query.factors, profile

    def query(self, windows: Windows, sessions: Sessions) -> Query:
        """What the scores of windows of `Decider.asked` are made from."""
        normalized, shown = self._policy.normalized(windows), sessions.shown
        features = self._features(normalized)
        inputs = [features / features.shape[-1] ** 0.5]
        weights = []
        if self._exposure is not None:
            exposed = _exposed(shown, self._exposure.lags, normalized)
            weights.append(self._exposure.weights(exposed))
        if self._model is not None:
            tastes = self._model.tastes_after(shown)
            query = self._model.query(windows.states[:, -1], sessions.users, tastes)
            inputs.append(self._reward_weight * query)
            of_model = self._model.exposures(shown)[1:]
            weights.append((self._reward_weight * of_model[0], self._reward_weight * of_model[1]))
        factors = torch.cat(inputs, 1)
        if self._likeness is None:
            nothing = factors[:, :0]
            return Query(factors, nothing.long(), nothing, nothing)
        repeated, alike = map(_sum, zip(*weights, strict=True))
        items = _padded(shown.items, repeated.shape[1], -1)
        return Query(factors, items, repeated, alike)


class _TagSums:
    """Likeness of all items to profiles of tags: computed once for items of the same tags."""

    def __init__(self, likeness: Likeness) -> None:
        tags, n_tags = likeness.tags.numpy(), int(likeness.n_tags)
        distinct, which = np.unique(tags, axis=0, return_inverse=True)
        # Padding reads a column of zeros.
        self._distinct = torch.from_numpy(np.where(distinct < 0, n_tags, distinct))
        self._which = torch.from_numpy(which.reshape(-1).astype(np.int32))

    def of(self, profile: Tensor) -> Tensor:
        """(B, n_items) from profiles (B, n_tags)."""
        sums = F.pad(profile, (0, 1))[:, self._distinct].sum(-1)
        return sums.index_select(1, self._which)

    def of_items(self, profile: Tensor, items: Tensor) -> Tensor:
        """(B, C) of items (B, C) from profiles (B, n_tags)."""
        tags = self._distinct[self._which[items].long()]  # (B, C, T)
        return F.pad(profile, (0, 1)).gather(1, tags.flatten(1)).view(tags.shape).sum(2)


def _tags_left_out(decider: Decider, shown: Shown, items: Tensor) -> Tensor:
    """(B, C) whether the rule leaves out items (B, C) for their tags, as long as others remain."""
    without = torch.zeros(items.shape, dtype=torch.bool)
    if decider.rule.tag_window:
        assert decider.likeness is not None
        tags, recent = decider.likeness.tags, shown.items[:, : decider.rule.tag_window]
        before = tags[recent.clamp(min=0)].masked_fill((recent < 0).unsqueeze(-1), -1).flatten(1)
        for tag in tags[items].unbind(2):
            without |= (tag.unsqueeze(2) == before.unsqueeze(1)).any(2) & (tag >= 0)
    if decider.rule.tag_run:
        assert decider.main_tags is not None
        tired = decider.main_tags.tired(shown, decider.rule.tag_run).unsqueeze(1)
        without |= (decider.main_tags.tags[items] == tired) & (tired >= 0)
    return without


def _likenesses(head: ItemHead, model: ItemRewardModel | None) -> list[Likeness]:
    found = [] if head.exposure is None else [head.exposure.likeness]
    return found if model is None else [*found, model.likeness]


def _equal(one: Likeness | None, other: Likeness) -> bool:
    assert one is not None
    pairs = ((one.tags, other.tags), (one.directions, other.directions))
    return all(torch.equal(*pair) for pair in pairs)


def _columns(factors: list[Tensor]) -> Tensor:
    """(Σ d, n_items) of vectors (n_items, d) each. A product with one row reads this layout twice
    as fast as vectors one after the other."""
    # NumPy asks for large pages, which are read faster.
    sizes = [each.shape[1] for each in factors]
    matrix = torch.from_numpy(np.empty((sum(sizes), len(factors[0])), dtype=np.float32))
    for part, each in zip(torch.split(matrix, sizes), factors, strict=True):
        part.copy_(each.T)
    return matrix


def _exposed(shown: Shown, lags: int, normalized: Windows) -> Exposed:
    items, rewards = _padded(shown.items[:, :lags], lags, -1), _padded(shown.rewards, lags, 0)
    return Exposed(items, rewards, normalized.returns_to_go[:, -1])


def _padded(values: Tensor, length: int, padding: int) -> Tensor:
    """The first `length` columns of values (B, N), with more columns where there are fewer."""
    missing = max(0, length - values.shape[1])
    return F.pad(values[:, :length], (0, missing), value=padding)


def _sum(parts: tuple[Tensor, ...]) -> Tensor:
    """The sum of weights (B, N) with zeros for missing columns."""
    if len(parts) == 1:
        return parts[0]
    length = max(each.shape[1] for each in parts)
    return _padded(parts[0], length, 0) + _padded(parts[1], length, 0)
