"""What rules would have done at logged steps, and the choice of a reward weight by it.

Where the log has no true sessions, a candidate is worth the mean rate, in the validation period, of
the ten items that it would show, corrected by what users liked of these, and overlaps with the log
enough if it finds liked items better than the ten most liked ones do, by a standard error.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule, best_items
from ucfrec.acting.scorer import Query, Scorer, sessions_before
from ucfrec.arrays import Array, BoolArray, Float64Array, IntArray
from ucfrec.choosing.choice import (
    Problem,
    RankedRule,
    RankingReport,
    RuleChoice,
    RuleEvidence,
    RuleRecord,
)
from ucfrec.episodes.states import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.episodes.windows import Sessions, seen_before
from ucfrec.policies.baselines import RecentClicksPolicy
from ucfrec.processes import progress
from ucfrec.results.statistics import effective_number
from ucfrec.user_model.reward_report import (
    draw_episodes,
    draw_numbers,
    draw_steps,
    number_users,
    read_propensities,
)

SHOWN = 10
"""Items that a rule shows at a step."""
_AT_ONCE = 256
_SCORES_AT_ONCE = 2**24
"""Most scores of a batch, rows × items: 64 MiB."""
_FEWEST_STEPS, _MOST_STEPS = 4000, 20_000
"""Validation rows that are ranked at most, in large and in small catalogues …"""
_SCORES = 2e8
"""… and in between, as many as have so many scores. Few rows say little where hits are rare."""
_HALVINGS = 3
"""How often the interval between the best reward weight and the next larger one is halved."""
_PRIOR = 10.0
"""Impressions at the mean rate that are added to those of an item."""


class LoggedScores:
    """Scores of all items at M logged steps by rules of one policy: what all rules of a target
    share is computed once, and kept where the policy has factors, which are few numbers."""

    def __init__(
        self,
        scorer: Scorer,
        view: EpisodeStore,
        episodes: IntArray,
        steps: IntArray,
    ) -> None:
        self.view, self.episodes, self.steps = view, episodes, steps
        self.items = view.items_at(episodes, steps)
        """(M,) logged."""
        self.liked = liked_rewards(view, view.step_values(schema.REWARD, episodes, steps))
        """(M,) bool."""
        self.scorer = scorer
        self._queries: dict[tuple[object, ...], Query] = {}

    @torch.no_grad()
    def score(self, rules: Sequence[DecisionRule]) -> Iterator[tuple[slice, int, Tensor]]:
        """Of batches of the steps, scores (B, n_items) by each rule: steps, rule, scores."""
        scorers = [self.scorer.under(rule) for rule in rules]
        widest = max(scorers, key=attrgetter("reach"))
        weighted = any(rule.reward_weight for rule in rules)
        with progress(len(self.steps), "logged steps under each rule", "rows") as bar:
            n_items = len(self.view.item_states.embeddings)
            at_once = max(1, min(_AT_ONCE, _SCORES_AT_ONCE // n_items))
            for first in range(0, len(self.steps), at_once):
                part = slice(first, first + at_once)
                episodes, steps = self.episodes[part], self.steps[part]
                queries = self._queries if self.scorer.has_factors else {}
                sessions: Sessions | None = None
                for number, (rule, scorer) in enumerate(zip(rules, scorers, strict=True)):
                    key = first, rule.target, rule.minimum_target, widest.reach, weighted
                    if key not in queries:
                        sessions = sessions or sessions_before(widest, self.view, episodes, steps)
                        query = scorer.query(sessions, rewards=weighted)
                        # What has been read for the query is not needed again.
                        queries[key] = query._replace(sessions=replace(sessions, states=None))
                    seen = seen_before(self.view, episodes, steps) if rule.exclude_seen else None
                    scores = scorer.scores_of(queries[key], excluded=seen, empty=seen is not None)
                    yield part, number, scores
                bar.update(len(steps))


class LoggedEvidence:
    """Validation sessions on which rules of one policy are compared with the log."""

    def __init__(
        self,
        scorer: Scorer,
        view: EpisodeStore,
        most: int,
        seed: int,
    ) -> None:
        """Draws about `most` steps of whole sessions of a view."""
        view = view.select(np.sort(draw_episodes(view, most, [seed, 7])))
        episodes, steps = view.all_steps()
        self._logged = LoggedScores(scorer, view, episodes, steps)
        lists = [view.items_above(episodes, steps), self._logged.items[:, None]]
        self._lists = torch.from_numpy(np.hstack(lists))
        self.propensities = read_propensities(view, episodes, steps)
        """(M,) if all steps have one."""
        self._users = np.unique(number_users(view), return_inverse=True)[1]
        self.n_users = int(self._users.max(initial=-1)) + 1

    def evaluate(self, rules: Sequence[DecisionRule]) -> list[RuleEvidence]:
        """The evidence of each rule."""
        shape = len(rules), len(self._logged.steps)
        logs, hits = np.zeros(shape), np.zeros(shape, dtype=bool)
        terms = [self._logged.scorer.under(rule).list_term for rule in rules]
        for part, n, scores in self._logged.score(rules):
            if self.propensities is not None:
                chances = rules[n].log_probabilities_of(scores, self._lists[part], terms[n])
                logs[n, part] = chances.double().numpy()
            top = best_items(scores, min(SHOWN, scores.shape[1]))
            hits[n, part] = (top == self._lists[part, -1:]).any(1).numpy()
        return [self._weigh(logs[n], hits[n]) for n in range(len(rules))]

    def _weigh(self, logs: Float64Array, hits: BoolArray) -> RuleEvidence:
        liked, view = self._logged.liked, self._logged.view
        rate = float(hits[liked].mean()) if liked.any() else 0.0
        if self.propensities is None:
            return RuleEvidence(rate)
        sums = np.bincount(self._logged.episodes, logs - np.log(self.propensities))
        weights = np.exp(np.minimum(sums, 100.0))
        above = np.bincount(self._users, weights * view.returns).astype(np.float64)
        below = np.bincount(self._users, weights).astype(np.float64)
        if not below.any():
            return RuleEvidence(rate, 0.0)
        halves = [half for half in (below[::2], below[1::2]) if len(half)]
        effective_users = 2 * min(effective_number(half) for half in halves)
        spread = float(sums[np.isfinite(sums)].var())
        value = above.sum() / below.sum()
        error = np.sqrt(np.square(above - value * below).sum()) / below.sum()
        return RuleEvidence(rate, effective_users, spread, value, error)


class LoggedOutcomes(NamedTuple):
    """What rules do at M logged rows."""

    users: IntArray
    """(M,)."""
    liked: BoolArray
    """(M,)."""
    baseline: BoolArray
    """(M,) whether the item is one of ten that all users like."""
    keep_hits: float
    hits: dict[DecisionRule, BoolArray]
    """(M,) whether the item is among the ten that a rule shows."""
    values: dict[DecisionRule, Float64Array]
    """(M,) whose mean is that of `RankedRule.value`."""

    def rank(self) -> list[RankedRule]:
        """The rules, in the order in which they were tried."""
        n_liked, ranked = max(1, int(self.liked.sum())), list[RankedRule]()
        without = min(self.hits, key=attrgetter("reward_weight"))
        enough = self.keep_hits * (self.hits[without] & self.liked).sum()
        for rule, hits in self.hits.items():
            # 1 for a liked item that only the rule shows, −1 for one that only the baseline does.
            ahead = (hits.astype(np.float64) - self.baseline) * self.liked
            gain, n_hits = float(ahead.sum()) / n_liked, int((hits & self.liked).sum())
            error = _error_of_sum(ahead - gain * self.liked, self.users) / n_liked
            overlaps = gain >= error and n_hits >= enough
            value = float(self.values[rule].mean())
            ranked.append(RankedRule(rule, value, n_hits / n_liked, gain, error, bool(overlaps)))
        return ranked

    def choose(self) -> RankedRule:
        """The rule with the highest value, and of equal ones that with the most hits, of those that
        overlap enough; without any, of those that hit about as often as the best one."""
        ranked = self.rank()
        allowed = [rule for rule in ranked if rule.overlaps]
        if not allowed:
            most = max(ranked, key=attrgetter("gain"))
            allowed = [rule for rule in ranked if rule.gain >= most.gain - most.gain_error]
        top, level = max(allowed, key=attrgetter("value")), list[RankedRule]()
        for rule in allowed:
            below = self.values[top.rule] - self.values[rule.rule]
            if below.sum() <= _error_of_sum(below - below.mean(), self.users):
                level.append(rule)
        return max(level, key=attrgetter("hits"))


def choose_by_ranking(problem: Problem) -> RuleChoice:
    """Choose the reward weight of the rule, as `LoggedOutcomes.choose`; its other parts stay. If
    the next larger candidate overlaps too little, weights between the two are tried."""
    train, validation, scorer = problem.train, problem.validation, problem.scorer
    n_items = len(train.item_states.embeddings)
    most, n_shown = int(np.clip(_SCORES / n_items, _FEWEST_STEPS, _MOST_STEPS)), min(SHOWN, n_items)
    episodes, steps = draw_steps(validation, most, problem.seed)
    logged = LoggedScores(scorer, validation, episodes, steps)
    mixture = RecentClicksPolicy.choose_mixture(train, validation)
    baselines = [
        np.isin(logged.items, scores.topk(n_shown).indices.numpy()) & logged.liked
        for scores in (RecentClicksPolicy.scores_of(train, m) for m in (None, mixture))
    ]
    counts = TrainingCounts.of(validation)
    impressions, likes = counts.shown.double().numpy(), counts.liked.double().numpy()
    rates = (likes + _PRIOR * likes.sum() / impressions.sum()) / (impressions + _PRIOR)
    users = number_users(validation)[episodes]
    baseline, keep_hits = max(baselines, key=np.sum), problem.config.keep_hits
    outcomes = LoggedOutcomes(users, logged.liked, baseline, keep_hits, {}, {})

    def try_weights(weights: Sequence[float]) -> RankedRule:
        rules = [replace(scorer.rule, reward_weight=weight) for weight in weights]
        tops = np.zeros((len(rules), len(logged.steps), n_shown), dtype=np.int64)
        for part, n, scores in logged.score(rules):
            tops[n, part] = best_items(scores, n_shown).numpy()
        for rule, top in zip(rules, tops, strict=True):
            hits = (top == logged.items[:, None]).any(1)
            liked_more = hits * (logged.liked - rates[logged.items])
            outcomes.hits[rule] = hits
            outcomes.values[rule] = rates[top].mean(1) + liked_more * len(hits) / (
                hits.sum() + _PRIOR
            )
        return outcomes.choose()

    best = try_weights(sorted({0.0, *problem.config.reward_weights}))
    for _ in range(_HALVINGS):
        weight = best.rule.reward_weight
        by_weight = {candidate.rule.reward_weight: candidate for candidate in outcomes.rank()}
        nearest = min((larger for larger in by_weight if larger > weight), default=weight)
        if by_weight[nearest].overlaps:
            break
        best = try_weights([(weight + nearest) / 2])
    warning = "; WARNING: no candidate does, this one is among those with the most hits"
    chosen = RuleRecord(
        rule=best.rule,
        chosen_by="mean rate, on validation rows, of the ten items shown, among rules that find "
        "liked items better than the ten most liked ones do, of all time or lately, by a standard "
        f"error, and {keep_hits:.0%} of those without the reward model; no propensities are used",
        tried=len(outcomes.hits),
        warning="" if best.overlaps else warning,
    )
    return chosen, outcomes.rank()


def measure_ranking(
    scorer: Scorer, train: EpisodeStore, validation: EpisodeStore, seed: int
) -> RankingReport:
    """How the policy ranks validation rows without what the user has seen, as `recommend` does,
    beside the items that are shown most of late."""

    def shown(view: EpisodeStore, rewards: Array) -> BoolArray:
        return np.ones(len(rewards), dtype=bool)

    numbers = draw_numbers(validation.n_steps, _FEWEST_STEPS, seed)
    episodes, steps = validation.locate(numbers)
    logged = LoggedScores(scorer, validation, episodes, steps)
    rows = UserRows.of(validation, number_users(validation), train)
    mixture = RecentClicksPolicy.choose_mixture(train, validation, shown)
    demand = RecentClicksPolicy.scores_of(train, mixture, shown)
    gains = np.zeros((2, len(steps)))
    for part, _, scores in logged.score([scorer.rule]):
        scores = scores.clone()
        scores[rows.seen(numbers[part])] = -torch.inf
        items = torch.from_numpy(logged.items[part]).unsqueeze(1)
        baseline = demand.masked_fill(scores.isneginf(), -torch.inf)
        for number, values in enumerate((scores, baseline)):
            logged_score = values.gather(1, items)
            places = (values > logged_score).sum(1) + 1
            is_hit = (places <= SHOWN) & ~logged_score.isneginf()[:, 0]
            gains[number, part] = (is_hit / torch.log2(places + 1.0)).numpy()
    hits = (gains > 0).mean(1)
    ndcg = gains.mean(1)
    return RankingReport(
        rows=len(steps),
        hits=float(hits[0]),
        ndcg=float(ndcg[0]),
        baseline_hits=float(hits[1]),
        baseline_ndcg=float(ndcg[1]),
    )


def _error_of_sum(values: Float64Array, users: IntArray) -> float:
    """Standard error of the sum of values (M,) of mean 0, whose rows depend within users (M,)."""
    return float(np.sqrt(np.square(np.bincount(users, values)).sum()))
