"""What several decision rules of one policy would have done at logged steps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule, best_items
from ucfrec.acting.scorer import Query, Scorer, sessions_before
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.episodes.states import liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions, seen_before
from ucfrec.progress import progress
from ucfrec.results.statistics import effective_number

SHOWN = 10
"""Items that a rule shows at a step."""
_AT_ONCE = 256
_Z = 1.96


class LoggedScores:
    """Scores of all items at M logged steps by rules of one policy.

    Policy and reward model are computed once for all rules of one target, and where the policy has
    factors kept for rules that are asked for later: the outputs of others are as many as items.
    """

    def __init__(
        self, scorer: Scorer, view: EpisodeStore, episodes: IntArray, steps: IntArray
    ) -> None:
        self._scorer, self._view, self._episodes, self._steps = scorer, view, episodes, steps
        self._queries: dict[tuple[object, ...], Query] = {}

    @torch.no_grad()
    def of(self, rules: Sequence[DecisionRule]) -> Iterator[tuple[slice, list[Tensor]]]:
        """Scores (B, n_items) by each rule of batches of the steps, and which steps they are."""
        scorers = [self._scorer.under(rule) for rule in rules]
        widest = max(scorers, key=lambda scorer: scorer.reach)
        weighted = any(rule.reward_weight for rule in rules)
        with progress(len(self._steps), "logged steps under each rule", "rows") as bar:
            for first in range(0, len(self._steps), _AT_ONCE):
                part = slice(first, min(first + _AT_ONCE, len(self._steps)))
                at = self._episodes[part], self._steps[part]
                queries = self._queries if self._scorer.has_factors else {}
                sessions: Sessions | None = None
                scores = list[Tensor]()
                for scorer in scorers:
                    rule = scorer.rule
                    key = first, rule.target, rule.minimum_target, widest.reach, weighted
                    if key not in queries:
                        sessions = sessions or sessions_before(widest, self._view, *at)
                        query = scorer.query(sessions, rewards=weighted)
                        # What has been read for the query is not needed again.
                        queries[key] = query._replace(sessions=replace(sessions, states=None))
                    seen = seen_before(self._view, *at) if rule.exclude_seen else None
                    scores.append(scorer.scores_of(queries[key], excluded=seen))
                yield part, scores
                bar.update(part.stop - part.start)


@dataclass(frozen=True)
class Evidence:
    """What validation sessions show of a rule without any model of the users."""

    hits: float
    """Share of liked steps whose item is among the ten best."""
    likelihood: float
    """Geometric mean of the probabilities with which the rule shows what was logged."""
    effective_users: float | None = None
    """Users of equal weight that say as much of the rule as the logged ones, whose sessions are
    weighted by the rule's over the logged probabilities; of the half of the users with fewer, twice
    the number. None without propensities."""
    spread: float = 0.0
    """Variance of the logarithms of the sessions' weights that are not 0. It says more reliably
    than the weights how heavy their tail is: few sessions may lack the heavy ones."""
    value: float | None = None
    """Off-policy estimate of the return of a session (SNIPS); None where nothing has weight."""
    error: float | None = None
    """Its standard error over users."""

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95% interval of `value`."""
        if self.value is None or self.error is None:
            return None
        return self.value - _Z * self.error, self.value + _Z * self.error


class LoggedEvidence:
    """Validation sessions on which rules of one policy are compared with the log."""

    def __init__(self, scorer: Scorer, view: EpisodeStore, most: int, seed: int) -> None:
        """Args:
        scorer: the policy.
        view: validation episodes.
        most: about the number of steps of the sessions that are drawn from many.
        seed: of the draw.
        """
        order = np.random.default_rng([seed, 7]).permutation(view.n_episodes)
        last = int(np.searchsorted(np.cumsum(view.lengths[order]), most))
        self._view = view.select(np.sort(order[: last + 1]))
        self._episodes, self._steps = self._view.all_steps()
        at = self._episodes, self._steps
        self._items = torch.from_numpy(self._view.step_values(schema.ITEM, *at).astype(np.int64))
        self._liked = liked_rewards(self._view, self._view.column(schema.REWARD))
        self._propensities: Float64Array | None = None
        if schema.PROPENSITY in view.record.columns:
            propensities = self._view.step_values(schema.PROPENSITY, *at).astype(np.float64)
            self._propensities = propensities if (propensities > 0).all() else None
        owners = np.arange(self._view.n_episodes)
        if view.has_users:
            owners = self._view.episode_values(schema.USER)
        self._users = np.unique(owners, return_inverse=True)[1]
        self._scores = LoggedScores(scorer, self._view, *at)

    @property
    def has_propensities(self) -> bool:
        """Whether all steps have one."""
        return self._propensities is not None

    @property
    def users(self) -> int:
        """The number of users."""
        return int(self._users.max(initial=-1)) + 1

    def of(self, rules: Sequence[DecisionRule]) -> list[Evidence]:
        """The evidence of each rule."""
        shape = len(rules), len(self._steps)
        logs, hits = np.zeros(shape), np.zeros(shape, dtype=bool)
        for part, scores in self._scores.of(rules):
            items = self._items[part].unsqueeze(1)
            for n, (rule, values) in enumerate(zip(rules, scores, strict=True)):
                chances = rule.log_probabilities(values)
                logs[n, part] = chances.gather(1, items)[:, 0].double().numpy()
                top = best_items(values, min(SHOWN, values.shape[1]))
                hits[n, part] = (top == items).any(1).numpy()
        return [self._evidence(*pair) for pair in zip(logs, hits, strict=True)]

    def _evidence(self, logs: Float64Array, hits: BoolArray) -> Evidence:
        rate = float(hits[self._liked].mean()) if self._liked.any() else 0.0
        likelihood = float(np.exp(logs.mean()))
        if self._propensities is None:
            return Evidence(rate, likelihood)
        sums = np.bincount(self._episodes, logs - np.log(self._propensities))
        weights = np.exp(np.minimum(sums, 100.0))
        returns = self._view.returns.astype(np.float64)
        above, below = (
            np.bincount(self._users, values).astype(np.float64)
            for values in (weights * returns, weights)
        )
        halves = [half for half in (below[::2], below[1::2]) if len(half)]
        effective_users = 2 * min(effective_number(half) for half in halves)
        if not below.any():
            return Evidence(rate, likelihood, 0.0)
        spread = float(sums[np.isfinite(sums)].var())
        value = above.sum() / below.sum()
        error = np.sqrt(np.square(above - value * below).sum()) / below.sum()
        return Evidence(rate, likelihood, effective_users, spread, float(value), float(error))
