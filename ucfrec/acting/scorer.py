"""One scorer: what turns the histories of sessions into scores of items under a decision rule.

Acting, off-policy estimates, rankings, recommendations and exported graphs all decide by these
scores. All operations can be exported to ONNX.
"""

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

import torch
from torch import Tensor

from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.item_product import ItemProduct, Part
from ucfrec.arrays import Float32Array, IntArray
from ucfrec.episodes.item_table import WINDOW
from ucfrec.episodes.returns import ReturnToGo
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions, Windows, seen_before
from ucfrec.errors import InputError
from ucfrec.policies.base import SequencePolicy
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.session_end import SessionEnd

_LOOKED_AT: Final = 64
"""Items of a decision that a lookahead asks about."""


Engine = Callable[[Sessions, Tensor], Tensor]
"""Gives the scores (1, n_items) of a single session, with what may not be shown, bool of that
size."""


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
        parts = (None if part is None else part.at(rows) for part in (self.policy, self.model))
        policy, model = parts
        return Query(
            self.sessions.at(rows),
            self.states[rows],
            self.items[rows],
            policy,
            None if self.outputs is None else self.outputs[rows],
            None if self.features is None else self.features[rows],
            model,
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
        """
        Args:
            policy: in evaluation mode; its weights must not change after the first scores.
            states: of the run's items; None if actions are vectors.
            returns: what the returns-to-go of the training counted; None for whole sessions.
            reward_model: f̂_r; needed for a reward weight.
            session_end: of the user model; needed for a lookahead.

        Raises:
            InputError: the rule needs what the run lacks.
        """
        self.policy, self.rule, self.states = policy, rule, states
        self.returns, self.reward_model = returns or ReturnToGo(), reward_model
        self.session_end = session_end
        self._outcomes: tuple[float, float] | None = None
        if session_end is not None and reward_model is not None and bool(reward_model.binary):
            self._outcomes = float(reward_model.reward_low), float(reward_model.reward_high)
        self._items = ItemProduct(policy, reward_model, states)
        self._engine: Engine | None = None
        self._require_parts()

    def under(self, rule: DecisionRule) -> "Scorer":
        """The same policy under another rule; what is computed once is shared.

        Raises:
            InputError: the rule needs what the run lacks.
        """
        scorer = copy.copy(self)
        scorer.rule, scorer._engine = rule, None
        scorer._require_parts()
        return scorer

    def answering_one_with(self, engine: Engine) -> "Scorer":
        """The same, but the scores of a single session are computed by `engine`."""
        scorer = copy.copy(self)
        scorer._engine = engine
        return scorer

    def _require_parts(self) -> None:
        rule, tags = self.rule, None if self.states is None else self.states.tags
        if rule.reward_weight and self.reward_model is None:
            raise InputError(
                f"the rule has reward weight {rule.reward_weight:g}, but the run has no "
                "reward model of items; train it with --set rule.choose=true, or set the reward "
                "weight to 0"
            )
        if rule.looks_ahead and self.session_end is None:
            raise InputError(
                f"the rule has lookahead {rule.lookahead:g}, but the run has no model of session "
                "ends; train it on a log with sessions, or set the lookahead to 0"
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
        return self.has_factors and self.rule.policy_weight == 1 and not self.rule.looks_ahead

    def vectors(self) -> Float32Array:
        """(n_items, d + 1) vectors of all items; their products with `multipliers` of factors are
        most of the scores."""
        return self._items.vectors(bool(self.rule.reward_weight))

    @torch.no_grad()
    def windows(self, sessions: Sessions) -> Windows:
        """What the policy reads of sessions, with the returns-to-go that the rule sets as target.

        Args:
            sessions: as of `scores`, or of vector actions with states.
        """
        best, windows = None, sessions.windows(self.states, self.policy.config.context)
        if self.rule.target is None:
            best = self.policy.max_return(windows.to(self.policy.state_mean.device)).cpu()
        targets = self.rule.target_returns(self.returns, sessions.collected, best)
        returns_to_go = self.returns.before(targets, windows.rewards)
        return replace(windows, returns_to_go=returns_to_go.masked_fill(~windows.mask, 0.0))

    @torch.no_grad()
    def act(self, sessions: Sessions) -> Tensor:
        """The policy's outputs at the last step, on the CPU: see `SequencePolicy.act`."""
        return self.policy.act(self.windows(sessions).to(self.policy.state_mean.device)).cpu()

    @torch.no_grad()
    def query(
        self, sessions: Sessions, windows: Windows | None = None, rewards: bool | None = None
    ) -> Query:
        """All of the scores that does not grow with the items, before it is weighted.

        Args:
            windows: of `windows`; None to make them.
            rewards: whether it is also used under rules with a reward weight; None if this one
                has one.
        """
        windows = self.windows(sessions) if windows is None else windows
        rewards = bool(self.rule.reward_weight) if rewards is None else rewards
        outputs = features = policy = None
        if self.has_factors:
            features, policy = self._items.policy_part(windows, sessions.shown)
        else:
            outputs = self.policy.act(windows.to(self.policy.state_mean.device)).cpu()
        # A view of several windows would keep all of their states.
        states = windows.states[:, -1].contiguous()
        model = self._items.model_part(sessions, states) if rewards else None
        items = self._items.shown(sessions.shown)
        return Query(sessions, states, items, policy, outputs, features, model)

    def weighted(self, query: Query) -> Part:
        """The parts of a query, weighted as the rule says."""
        weight = self.rule.reward_weight
        model = query.model if weight else None
        return self._items.weighted(query.items, query.policy, model, weight)

    def scores(
        self,
        sessions: Sessions,
        left_out: tuple[Tensor, Tensor] | None = None,
        excluded: Tensor | None = None,
        *,
        empty: bool = False,
    ) -> Tensor:
        """(B, n_items) log π(i | s, Ĝ) + β f̂_r(s, i), up to a constant per row; −∞ for items left
        out.

        Args:
            sessions: of at least `reach` items with their states, or of `length` items.
            left_out: rows (N,) and items (N,) of what may not be shown.
            excluded: (B, n_items) or (n_items,) bool, what may not be shown.
            empty: whether all items of a row may be excluded.

        Raises:
            InputError: no item is left in some row, or the scores of some row are NaN.
        """
        exporting = torch.compiler.is_exporting()
        serving = sessions.states is None and self.is_product and not exporting
        # Policies and fits may keep tensors, which those of inference mode would spoil for them.
        with torch.inference_mode() if serving else torch.no_grad():
            if self._engine is not None and len(sessions.users) == 1:
                without = torch.zeros(1, self._items.count, dtype=torch.bool)
                if left_out is not None:
                    without[left_out] = True
                if excluded is not None:
                    without |= excluded
                return _require_scores(self._engine(sessions, without), empty)
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
        if self.rule.policy_weight == 1 and not self.rule.looks_ahead:
            part, rewards = self.weighted(query), bool(self.rule.reward_weight)
            outputs = query.outputs
            scores = self._items.scores(query.items, part, outputs, self.has_factors, rewards)
        else:
            scores = self._compose(query)
        if not torch.compiler.is_exporting():
            _require_scores(scores, empty=True)
        if left_out is not None:
            scores[left_out] = -torch.inf
        if excluded is not None:
            scores = scores.masked_fill_(excluded, -torch.inf)
        for without in self._items.without_tags(self.rule, query.sessions.shown):
            left = scores.masked_fill(without, -torch.inf)
            # A filter gives way where nothing would remain.
            some = left.amax(1, keepdim=True) > -torch.inf
            every = not torch.compiler.is_exporting() and bool(some.all())
            scores = left if every else torch.where(some, left, scores)
        return scores if empty else _require_scores(scores, empty)

    @torch.no_grad()
    def rewards(self, sessions: Sessions) -> Tensor:
        """f̂_r (B, n_items), in the reward model's units, up to a constant per row."""
        states = sessions.windows(self.states, 1).states[:, -1]
        items, part = self._items.shown(sessions.shown), self._items.model_part(sessions, states)
        part = self._items.weighted(items, None, part, 1.0)
        return self._items.scores(items, part, None, policy=False, rewards=True)

    @torch.inference_mode()
    def scores_of_some(
        self, query: Query, part: Part, candidates: Tensor, products: Tensor
    ) -> Tensor:
        """Scores (B, C) of some items; −∞ for those that the rule's tags exclude, even if no
        others remain.

        Args:
            part: of `weighted`.
            candidates: (B, C) int64.
            products: (B, C) of `multipliers` of the part and the candidates' `vectors`.
        """
        rewards = bool(self.rule.reward_weight)
        scores = products + self._items.added(query.items, part, candidates, rewards)
        for without in self._items.without_tags(self.rule, query.sessions.shown, candidates):
            scores = scores.masked_fill(without, -torch.inf)
        return scores

    def _compose(self, query: Query) -> Tensor:
        """w log π + β f̂_r, or with a lookahead w log π + β (r̂ + (1 − p_end) V), (B, n_items)."""
        rule, product, scores = self.rule, self._items, torch.zeros(())
        if rule.policy_weight:
            part = product.weighted(query.items, query.policy, None, 0.0)
            of_policy = product.scores(query.items, part, query.outputs, self.has_factors, False)
            scores = rule.policy_weight * of_policy
        if query.model is not None and rule.reward_weight:
            part = product.weighted(query.items, None, query.model, 1.0)
            odds = product.scores(query.items, part, None, policy=False, rewards=True)
            if rule.looks_ahead:
                return self._ahead(scores, odds, query)
            scores = scores + rule.reward_weight * odds
        return scores.expand(query.items.shape[0], product.count).clone()

    def _ahead(self, scores: Tensor, odds: Tensor, query: Query) -> Tensor:
        """Scores of the policy plus expected reward and lookahead, (B, n_items).

        Only the best items by policy and reward are asked whether they end the session; others
        count like the worst of these.
        """
        model, end = self.reward_model, self.session_end
        assert model is not None
        assert end is not None
        users, shown = query.sessions.users, query.sessions.shown
        tastes = model.tastes_after(shown.latest(model.reach))
        odds = odds + model.level(query.states, users, tastes).unsqueeze(1)
        span = model.reward_high - model.reward_low
        weight, ahead = self.rule.reward_weight / span, self.rule.lookahead
        rewards = model.expected(odds)
        scores = scores + weight * rewards
        best = scores.topk(min(_LOOKED_AT, self._items.count), dim=1).indices
        steps = query.sessions.steps
        some, recent = rewards.gather(1, best), shown.latest(model.lags)
        if self._outcomes is not None and end.uses_rewards:
            rewarded = [torch.full_like(some, reward) for reward in self._outcomes]
            low, high = end.of_items(recent, best, rewarded, steps)
            ends = low + (high - low) * (some - model.reward_low) / span
        else:
            (ends,) = end.of_items(recent, best, [some], steps)
        added = (weight * ahead * (1 - ends)).to(scores.dtype)
        worst = added.amin(1, keepdim=True)
        return (scores + worst).scatter_add(1, best, added - worst)


def sessions_before(
    scorer: Scorer, store: EpisodeStore, episodes: IntArray, steps: IntArray
) -> Sessions:
    """What was known before steps (B,) of episodes (B,) of logs with the training's items."""
    return Sessions.from_store(store, episodes, steps, scorer.policy.config.context, scorer.reach)


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
    """Check scores (B, n_items), which are returned.

    Raises:
        InputError: those of some row are NaN, or infinitely high, or unless `empty` no item is
            left in it.
    """
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
