"""One scorer: what turns the histories of sessions into scores of items under a decision rule.

Acting, off-policy estimates, rankings, recommendations and exported graphs all decide by these
scores. All operations can be exported to ONNX.
"""

import copy
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule, ListTerm, best_items
from ucfrec.arrays import Float32Array, IntArray
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.item_table import WINDOW
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import (
    Exposed,
    Sessions,
    Shown,
    Windows,
    list_earlier,
    pad_columns,
    seen_before,
)
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.policies.heads import ItemHead
from ucfrec.user_model.fatigue import MainTags
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.session_end import SessionEnd

_LOOKED_AT = 64
"""Items of a decision that a lookahead asks about."""


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
        return Part._make(values[rows] for values in self)


class Query(NamedTuple):
    """What B sessions ask of all items; the rule's weights do not matter yet."""

    sessions: Sessions
    states: Tensor
    """(B, S) before the steps to decide."""
    items: Tensor
    """(B, N) int64 items shown before, −1 for none."""
    policy: Part | None
    """log π; None for a policy that scores items in a way of its own."""
    outputs: Tensor | None
    """(B, n_items) of such a policy."""
    features: Tensor | None
    """(B, D) that the policy predicts from; None for such a policy."""
    model: Part | None
    """f̂_r; None if it is not needed."""

    def at(self, rows: slice) -> "Query":
        """The sessions with the given numbers."""
        return Query._make(
            value if value is None else value[rows] if isinstance(value, Tensor) else value.at(rows)
            for value in self
        )


class Scorer:
    """A trained policy under a decision rule: w log π(i | s, Ĝ) + β f̂_r(s, i) of every item.

    The item vectors of the policy and of the reward model are one matrix, so that a single product
    gives both. Policies that score items in a way of their own do so, and the rest is added.
    """

    def __init__(
        self,
        policy: SequencePolicy,
        rule: DecisionRule,
        states: ItemStates | None = None,
        returns: ReturnToGo | None = None,
        reward_model: ItemRewardModel | None = None,
        session_end: SessionEnd | None = None,
    ) -> None:
        """InputError if the rule needs what the run lacks.

        Args:
            policy: in evaluation mode; its weights must not change after the first scores.
            states: of the run's items; None if actions are vectors.
            returns: what the returns-to-go of the training counted; None for whole sessions.
            reward_model: f̂_r; needed for a reward weight.
            session_end: of the user model; needed for a lookahead.
        """
        self.policy, self.rule, self.states = policy, rule, states
        self.returns = returns or ReturnToGo()
        self.reward_model = reward_model
        self.session_end = session_end
        self._has_two_rewards = reward_model is not None and bool(reward_model.binary)
        self._items = _ItemProduct(policy, reward_model, states)
        self.engine: Callable[[Sessions, Tensor], Tensor] | None = None
        """Scores (1, n_items) of one session, given what may not be shown, bool; None for torch."""
        self._require_parts()

    def under(self, rule: DecisionRule) -> "Scorer":
        """The same policy under another rule; what is computed once is shared. InputError if the
        rule needs what the run lacks."""
        scorer = copy.copy(self)
        scorer.rule, scorer.engine = rule, None
        scorer._require_parts()
        return scorer

    def _require_parts(self) -> None:
        rule = self.rule
        tags = None if self.states is None else self.states.tags
        if rule.reward_weight and self.reward_model is None:
            raise InputError(
                f"the rule has reward weight {rule.reward_weight:g}, but the run has no "
                "reward model of items; train it with --set rule.choose=true, or set the reward "
                "weight to 0"
            )
        if self.session_end is None and rule.looks_ahead:
            raise InputError(
                f"the rule has lookahead {rule.lookahead:g}, but the run has no model of session "
                "ends; train it on a log with sessions, or set the lookahead to 0"
            )
        if rule.by_marginal_gain and rule.looks_ahead:
            raise InputError(
                f"the rule builds lists by marginal gain, and has lookahead {rule.lookahead:g}, "
                "which counts single items; set the lookahead to 0, or by_marginal_gain to false"
            )
        for name, value in (("tag window", rule.tag_window), ("tag run", rule.tag_run)):
            if value and (tags is None or not bool((tags >= 0).any())):
                raise InputError(
                    f"the rule has a {name}, which excludes items by their tags, but the store "
                    f"has none; give the items a column of lists, or set the {name} to 0"
                )
        if rule.tag_window > self.known:
            raise InputError(
                f"the rule looks at the tags of the last {rule.tag_window} items, but of a "
                f"session {self.known} are known ({WINDOW}, or policy.context less 1 if that is "
                f"more); set the tag window to at most {self.known}"
            )

    @property
    def known(self) -> int:
        """The number of items of a session that are known at least, once it has shown them."""
        return max(self.policy.config.context - 1, WINDOW)

    @property
    def reach(self) -> int:
        """Items shown before a step that are read one by one."""
        of_model = 0 if self.reward_model is None else self.reward_model.reach
        return max(of_model, self._items.lags, self.rule.tag_window, self.rule.tag_run)

    @property
    def length(self) -> int:
        """Items of a session that are read, also those that make its states."""
        assert self.states is not None
        return max(self.policy.config.context - 1 + self.states.window, self.reach)

    @property
    def has_factors(self) -> bool:
        """Whether the policy scores items by a product with their vectors."""
        return not self._items.own

    @property
    def is_product(self) -> bool:
        """Whether the scores are a product with vectors of the items, but for tags and repetition:
        of a policy that has factors, under a rule without lookahead or policy weight."""
        return self.has_factors and self._is_plain and self.list_term is None

    @property
    def _is_plain(self) -> bool:
        return self.rule.policy_weight == 1 and not self.rule.looks_ahead

    @property
    def list_term(self) -> ListTerm | None:
        """What items of a list add to the scores of those below them; None for nothing."""
        model, weight = self.reward_model, self.rule.reward_weight
        if not (self.rule.by_marginal_gain and weight and model is not None and model.above.any()):
            return None

        def add(items: Tensor) -> Tensor:
            weights = weight * model.above.expand(len(items), 1)
            profile = model.likeness.profile(items.unsqueeze(1), weights)
            return model.likeness.added_to(torch.zeros(len(items), self._items.count), profile)

        return add

    def vectors(self) -> Float32Array:
        """(n_items, d + 1) vectors of all items, the last column a bias; their products with the
        factors of `weigh` and 1 are most of the scores."""
        matrix, bias = self._items.rows(policy=True, rewards=bool(self.rule.reward_weight))
        return torch.cat([matrix.T, bias.unsqueeze(1)], dim=1).numpy()

    @torch.no_grad()
    def windows(self, sessions: Sessions) -> Windows:
        """What the policy reads of sessions, of items or, with states, of vector actions; the
        returns-to-go are those that the rule sets as target."""
        windows = sessions.windows(self.states, self.policy.config.context)
        targets = self.rule.target_returns(self.returns, sessions.collected)
        returns_to_go = self.returns.before(targets, windows.rewards)
        return replace(windows, returns_to_go=returns_to_go.masked_fill(~windows.mask, 0.0))

    @torch.no_grad()
    def act(self, sessions: Sessions, windows: Windows | None = None) -> Tensor:
        """The policy's outputs at the last step, on the CPU: see `SequencePolicy.act`."""
        windows = self.windows(sessions) if windows is None else windows
        return self.policy.act(windows.to(self.policy.state_mean.device)).cpu()

    @torch.no_grad()
    def query(
        self,
        sessions: Sessions,
        windows: Windows | None = None,
        rewards: bool | None = None,
    ) -> Query:
        """All of the scores that does not grow with the items, before it is weighted.

        `windows` are made if they are None. `rewards` says whether it is also used under rules with
        a reward weight, by default if this one has one.
        """
        windows = self.windows(sessions) if windows is None else windows
        rewards = bool(self.rule.reward_weight) if rewards is None else rewards
        outputs = features = policy = None
        if self.has_factors:
            features, policy = self._items.policy_part(windows, sessions.shown)
        else:
            outputs = self.act(sessions, windows)
        # A view of several windows would keep all of their states.
        states = windows.states[:, -1].contiguous()
        model = self._items.model_part(sessions, states) if rewards else None
        items = self._items.pad_items(sessions.shown)
        return Query(sessions, states, items, policy, outputs, features, model)

    def weigh(self, query: Query) -> Part:
        """The parts of a query, weighted as the rule says."""
        return self._items.weigh(query, True, self.rule.reward_weight)

    def scores(
        self,
        sessions: Sessions,
        left_out: tuple[Tensor, Tensor] | None = None,
        excluded: Tensor | None = None,
        *,
        empty: bool = False,
    ) -> Tensor:
        """(B, n_items) log π(i | s, Ĝ) + β f̂_r(s, i), up to a constant per row; −∞ for items left
        out. InputError if no item is left in some row, or the scores of some row are NaN.

        Args:
            sessions: of at least `reach` items with their states, or of `length` items.
            left_out: rows (N,) and items (N,) of what may not be shown.
            excluded: (B, n_items) or (n_items,) bool, what may not be shown.
            empty: whether all items of a row may be excluded.
        """
        exporting = torch.compiler.is_exporting()
        serving = sessions.states is None and self.is_product and not exporting
        # Policies and fits may keep tensors, which those of inference mode would spoil for them.
        with torch.inference_mode() if serving else torch.no_grad():
            if self.engine is not None and len(sessions.users) == 1:
                without = torch.zeros(1, self._items.count, dtype=torch.bool)
                if left_out is not None:
                    without[left_out] = True
                if excluded is not None:
                    without |= excluded
                if sessions.offer is not None:
                    without |= ~sessions.offer.mask()
                scores = self.engine(sessions, without)
                scores = scores + self.rule.reward_weight * self._sum_running(sessions)
                return _require_scores(scores, empty)
            return self.scores_of(self.query(sessions), left_out, excluded, empty=empty)

    @torch.no_grad()
    def scores_of(
        self,
        query: Query,
        left_out: tuple[Tensor, Tensor] | None = None,
        excluded: Tensor | None = None,
        *,
        empty: bool = False,
    ) -> Tensor:
        """`scores` of the sessions of a query."""
        rule, items = self.rule, self._items
        if self._is_plain:
            scores = items.scores(query, True, rule.reward_weight)
            if rule.reward_weight and query.sessions.offer is not None:
                scores = scores + rule.reward_weight * self._sum_running(query.sessions)
        else:
            if rule.policy_weight:
                scores = rule.policy_weight * items.scores(query, True, 0.0)
            else:
                scores = torch.zeros(query.items.shape[0], items.count)
            if rule.looks_ahead or rule.reward_weight:
                odds = items.scores(query, False, 1.0) + self._sum_running(query.sessions)
            if rule.looks_ahead:
                scores = self._add_lookahead(scores, odds, query)
            elif rule.reward_weight:
                scores = scores + rule.reward_weight * odds
        exporting = torch.compiler.is_exporting()
        if not exporting:
            _require_scores(scores, empty=True)
        if left_out is not None:
            scores[left_out] = -torch.inf
        if excluded is not None:
            scores = scores.masked_fill_(excluded, -torch.inf)
        if query.sessions.offer is not None:
            scores = scores.masked_fill_(~query.sessions.offer.mask(), -torch.inf)
        for without in items.without_tags(rule, query.sessions.shown):
            left = scores.masked_fill(without, -torch.inf)
            # A filter gives way where nothing would remain.
            some = left.amax(1, keepdim=True) > -torch.inf
            scores = left if not exporting and bool(some.all()) else torch.where(some, left, scores)
        return scores if empty else _require_scores(scores, empty)

    @torch.no_grad()
    def rewards(self, sessions: Sessions) -> Tensor:
        """f̂_r (B, n_items), in the reward model's units, up to a constant per row."""
        states = sessions.windows(self.states, 1).states[:, -1]
        part = self._items.model_part(sessions, states)
        items = self._items.pad_items(sessions.shown)
        query = Query(sessions, states, items, None, None, None, part)
        return self._items.scores(query, False, 1.0) + self._sum_running(sessions)

    def _sum_running(self, sessions: Sessions) -> Tensor:
        """(B, n_items) what running rates and ages add to f̂_r; 0 without."""
        model = self.reward_model
        return torch.zeros(()) if model is None else model.sum_running(sessions.offer)

    @torch.inference_mode()
    def scores_of_some(
        self,
        query: Query,
        part: Part,
        candidates: Tensor,
        left_out: tuple[Tensor, Tensor],
        products: Tensor | None = None,
    ) -> Tensor:
        """Scores (B, C) of some items, without a look at the others, if the rule `is_product`.

        Args:
            part: of `weigh`.
            candidates: (B, C) int64, sorted but for −1, which is none; repeated ones count once.
            left_out: rows (N,) and items (N,) of what may not be shown.
            products: (B, C) of the part's factors, and 1, with the candidates' `vectors`, of items
                that are not all: a tag filter does not give way, even if no others remain.
        """
        missing, items = candidates < 0, candidates.clamp(min=0)
        missing[:, 1:] |= candidates[:, 1:] == candidates[:, :-1]
        rewards = bool(self.rule.reward_weight)
        gives_way = products is None
        scores = self._items.scores_of_some(query.items, part, items, products, rewards)
        if query.sessions.offer is not None:
            if rewards:
                running = self._sum_running(query.sessions).expand(len(items), self._items.count)
                scores = scores + self.rule.reward_weight * running.gather(1, items)
            missing |= ~query.sessions.offer.mask().gather(1, items)
        _require_scores(scores, empty=True)
        # Pairs of a row and an item are single numbers.
        rows = torch.arange(len(items)).unsqueeze(1) * self._items.count
        missing |= torch.isin(rows + items, left_out[0] * self._items.count + left_out[1])
        scores = scores.masked_fill(missing, -torch.inf)
        for without in self._items.without_tags(self.rule, query.sessions.shown, items):
            left = scores.masked_fill(without, -torch.inf)
            some = left.amax(1, keepdim=True) > -torch.inf
            scores = torch.where(some, left, scores) if gives_way else left
        return scores

    def _add_lookahead(
        self,
        scores: Tensor,
        odds: Tensor,
        query: Query,
    ) -> Tensor:
        """Scores of the policy plus expected reward and lookahead, (B, n_items).

        Only the best items by policy and reward are asked whether they end the session; others
        count like the worst of these.
        """
        model, end = self.reward_model, self.session_end
        assert model is not None
        assert end is not None
        users, recent = query.sessions.users, query.sessions.shown
        tastes = model.tastes_after(query.sessions.shown_since.latest(model.reach), users)
        odds = odds + model.level(query.states, users, tastes).unsqueeze(1)
        span = model.reward_high - model.reward_low
        steps = query.sessions.steps
        weight = self.rule.reward_weight / span
        ahead = self.rule.lookahead
        rewards = model.expect(odds)
        scores = scores + weight * rewards
        best = best_items(scores, min(_LOOKED_AT, self._items.count))
        some, recent = rewards.gather(1, best), recent.latest(model.lags)
        if end.uses_rewards and self._has_two_rewards:
            outcomes = [v.expand_as(some) for v in (model.reward_low, model.reward_high)]
            low, high = end.score_items(recent, best, outcomes, steps)
            ends = low + (high - low) * (some - model.reward_low) / span
        else:
            (ends,) = end.score_items(recent, best, [some], steps)
        added = (weight * ahead * (1 - ends)).to(scores.dtype)
        worst = added.amin(1, keepdim=True)
        return (scores + worst).scatter_add(1, best, added - worst)


class _ItemProduct:
    """All items of a catalogue as a policy and a reward model see them, computed once.

    Rows of the matrix are the policy's vectors, the directions that items without tags are alike
    by, and the reward model's vectors and effects of items.
    """

    def __init__(
        self,
        policy: SequencePolicy,
        model: ItemRewardModel | None,
        states: ItemStates | None,
    ) -> None:
        self._policy, self._model, self._states = policy, model, states
        head, kind = policy.head, type(policy)
        self._head = head if isinstance(head, ItemHead) else None
        exposure = None if self._head is None else self._head.exposure
        self.lags = 0 if exposure is None else exposure.lags
        pairs: Iterable[tuple[Tensor, Tensor]] = ()
        if exposure is not None and model is not None:
            pairs = zip(exposure.likeness.buffers(), model.likeness.buffers(), strict=True)
        self.own = (
            self._head is None
            or kind.act is not SequencePolicy.act
            or kind.act_and_features is not SequencePolicy.act_and_features
            or not all(torch.equal(ours.cpu(), theirs.cpu()) for ours, theirs in pairs)
        )
        """Whether the policy scores items in a way of its own."""
        self._exposure = None if self.own else exposure
        terms = (term for term in (self._exposure, model) if term is not None)
        self._likeness = next((term.likeness for term in terms), None)
        self._by_direction = self._likeness is not None and not self._likeness.tags.shape[1]
        self._columns = max(self.lags, 0 if model is None else model.lags)

    @property
    def count(self) -> int:
        """n_items."""
        assert self._states is not None
        return len(self._states.embeddings)

    @cached_property
    def _matrix(self) -> tuple[Tensor, Tensor, tuple[int, int]]:
        """The matrix (d, n_items), the policy's bias (n_items,), and how many of the first rows
        are the policy's, and those or of likeness."""
        blocks, bias = list[Tensor](), torch.zeros(())
        with torch.no_grad():
            if not self.own:
                assert self._head is not None
                blocks = [(self._head.project(self._head.embeddings) + self._head.correction).cpu()]
                bias = (self._head.bias + self._head.recency).detach().cpu()
            of_policy = sum(block.shape[1] for block in blocks)
            if self._by_direction:
                assert self._likeness is not None
                blocks.append(self._likeness.directions.cpu())
            of_likeness = sum(block.shape[1] for block in blocks)
            if self._model is not None:
                blocks += [self._model.vectors, self._model.item.unsqueeze(1)]
            # A product with one row reads this layout twice as fast as vectors one after the
            # other; NumPy asks for large pages, which are read faster.
            sizes = [block.shape[1] for block in blocks]
            shape = sum(sizes), len(blocks[0])
            matrix = torch.from_numpy(np.empty(shape, dtype=np.float32))
            for rows, block in zip(torch.split(matrix, sizes), blocks, strict=True):
                rows.copy_(block.T)
            return matrix, bias, (of_policy, of_likeness)

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

    def pad_items(self, recent: Shown) -> Tensor:
        """(B, N) the items that repetition and likeness refer to."""
        return pad_columns(recent.items, self._columns, -1)

    def policy_part(self, windows: Windows, recent: Shown) -> tuple[Tensor, Part]:
        """The policy's features (B, d) and its part, from windows with their target returns."""
        device = self._policy.state_mean.device
        normalized = self._policy.normalize(windows.to(device))
        features = self._policy.last_features(normalized)
        repeated = alike = features.new_zeros(features.shape[0], self._columns)
        if self._exposure is not None:
            items, rewards = (values.to(device) for values in recent.padded(self.lags))
            exposed = Exposed(items, rewards, normalized.returns_to_go[:, -1])
            repeated, alike = (
                pad_columns(weights, self._columns, 0)
                for weights in self._exposure.weights(exposed)
            )
        part = Part(features / features.shape[-1] ** 0.5, repeated, alike)
        return features.cpu(), Part._make(values.cpu() for values in part)

    def model_part(self, sessions: Sessions, states: Tensor) -> Part:
        """The reward model's part, in states (B, S) before the steps to decide."""
        model, recent = self._model, sessions.shown
        assert model is not None
        tastes = model.tastes_after(sessions.shown_since, sessions.users)
        query = model.query(states, sessions.users, tastes)
        _, repeated, alike = model.exposures(recent)
        factors = F.pad(query, (0, 1), value=1.0)
        return Part(
            factors, pad_columns(repeated, self._columns, 0), pad_columns(alike, self._columns, 0)
        )

    def _counts_shown(self, policy: bool, rewards: bool) -> bool:
        """Whether what was shown counts."""
        return self._likeness is not None and (rewards or (policy and self._exposure is not None))

    def weigh(
        self,
        query: Query,
        policy: bool,
        reward_weight: float,
    ) -> Part:
        """The weighted sum of the parts; without a part, the rows of its own are excluded."""
        items, model = query.items, query.model if reward_weight else None
        repeated = alike = torch.zeros_like(items, dtype=torch.float32)
        factors = list[Tensor]()
        if policy and query.policy is not None:
            of_policy, repeated, alike = query.policy
            factors.append(of_policy)
        if model is not None:
            repeated = repeated + reward_weight * model.repeated
            alike = alike + reward_weight * model.alike
        if self._by_direction and self._counts_shown(policy, bool(reward_weight)):
            assert self._alike is not None
            factors.append(self._alike.profile(items, alike))
        if model is not None:
            factors.append(reward_weight * model.factors)
        return Part(torch.cat(factors, 1) if factors else repeated[:, :0], repeated, alike)

    def scores(
        self,
        query: Query,
        policy: bool,
        reward_weight: float,
    ) -> Tensor:
        """(B, n_items) of the policy and the weighted reward model, up to a constant per row."""
        items, outputs = query.items, query.outputs if policy else None
        if outputs is not None and not reward_weight:
            return outputs.clone()  # it may be what the policy keeps
        part = self.weigh(query, policy, reward_weight)
        matrix, bias = self.rows(policy, bool(reward_weight))
        scores = torch.addmm(bias if outputs is None else outputs, part.factors, matrix)
        if not self._counts_shown(policy, bool(reward_weight)):
            return scores
        if self._alike is not None and not self._by_direction:
            shared, sets = self._alike.to_sets(self._alike.profile(items, part.alike))
            scores = scores.add_(shared.index_select(1, sets))
        repeated = part.repeated.masked_fill(items < 0, 0.0)
        return scores.scatter_add_(1, items.clamp(min=0), repeated)

    def scores_of_some(
        self,
        items: Tensor,
        part: Part,
        candidates: Tensor,
        products: Tensor | None,
        rewards: bool,
    ) -> Tensor:
        """(B, C) as `scores` of candidates (B, C), from what was shown and weighted parts; the
        products with their vectors may be known."""
        if products is None:
            matrix, bias = self.rows(True, rewards)
            vectors = matrix.index_select(1, candidates.flatten())
            vectors = vectors.view(-1, len(candidates), candidates.shape[1])
            products = torch.einsum("bd,dbc->bc", part.factors, vectors)
            products += bias.expand(self.count)[candidates]
        if not self._counts_shown(True, rewards):
            return products
        if self._alike is not None and not self._by_direction:
            profile = self._alike.profile(items, part.alike)
            products = products + self._alike.to_candidates(profile, candidates)
        same = candidates.unsqueeze(2) == items.unsqueeze(1)
        return products + (same * part.repeated.unsqueeze(1)).sum(2)

    def without_tags(
        self,
        rule: DecisionRule,
        recent: Shown,
        items: Tensor | None = None,
    ) -> Iterator[Tensor]:
        """What each tag filter of the rule excludes, (B, n_items) bool, or (B, C) of items."""
        if rule.tag_window:
            latest = recent.items[:, : rule.tag_window]
            profile = self._tags.profile(latest, torch.ones(latest.shape))
            if items is None:
                shared, sets = self._tags.to_sets(profile)
                yield (shared > 0).index_select(1, sets)
            else:
                yield self._tags.to_candidates(profile, items) > 0
        if rule.tag_run:
            tired = self._main_tags.find_tired(recent, rule.tag_run).unsqueeze(1)
            main = self._main_tags.tags
            yield ((main if items is None else main[items]) == tired) & (tired >= 0)

    def rows(self, policy: bool, rewards: bool) -> tuple[Tensor, Tensor]:
        """The rows of the matrix that the factors multiply, and the bias."""
        matrix, bias, (of_policy, of_likeness) = self._matrix
        last = of_likeness if self._counts_shown(policy, rewards) else of_policy
        rows = matrix[0 if policy else of_policy : len(matrix) if rewards else last]
        return rows, bias if policy else torch.zeros(())


def sessions_before(
    scorer: Scorer,
    store: EpisodeStore,
    episodes: IntArray,
    steps: IntArray,
) -> Sessions:
    """What was known before steps (B,) of episodes (B,) of logs with the training's items."""
    context, model = scorer.policy.config.context, scorer.reward_model
    sessions = Sessions.from_store(store, episodes, steps, context, scorer.reach)
    if model is None or not model.interests.are_known:
        return sessions
    owner, earlier = list_earlier(sessions.steps.numpy())
    times = store.step_values(schema.TIMESTAMP, episodes[owner], earlier)
    trained_steps = model.interests.count_trained(sessions.users, owner, times)
    return replace(sessions, trained_steps=trained_steps)


def logged_scores(
    scorer: Scorer,
    store: EpisodeStore,
    episodes: IntArray,
    steps: IntArray,
    left_out: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """`Scorer.scores` (B, n_items) at logged steps, from what was known before each.

    With `left_out`, rows and items of what may not be shown, all items of a row may be excluded.
    """
    sessions = sessions_before(scorer, store, episodes, steps)
    seen = seen_before(store, episodes, steps) if scorer.rule.exclude_seen else None
    return scorer.scores(sessions, left_out, seen, empty=left_out is not None)


def _require_scores(scores: Tensor, empty: bool) -> Tensor:
    """Scores (B, n_items), checked. InputError if those of some row are NaN, or infinitely high, or
    unless `empty` no item is left in it."""
    highest = scores.amax(1)
    undefined = ~(highest < torch.inf)
    if undefined.any():
        raise InputError(
            f"in {int(undefined.sum())} of {len(scores)} decisions scores are not numbers, as "
            "weights of the policy or the reward model are NaN or infinite; train again, with "
            "a lower train.learning_rate if the training diverged"
        )
    if not empty and bool((none := torch.isneginf(highest)).any()):
        raise InputError(
            f"in {int(none.sum())} of {len(none)} decisions every item is excluded; allow "
            "more candidates, or keep seen items"
        )
    return scores
