"""Choose the reward weight of a run by how it ranks the validation rows of its log.

Where the log has no true sessions there is nothing to simulate, but every row shows what a user
liked. A candidate is worth the mean rate, in the validation period, of the ten items that it would
show, and overlaps with the log enough if it finds liked items better than the ten most liked ones
do, by a standard error. The choice is repeated on two halves of the users.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule, best_items
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.choosing.choice import Problem, RankedRule, RuleChoice
from ucfrec.choosing.logged import SHOWN, LoggedScores
from ucfrec.episodes.states import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore

_FEWEST_STEPS, _MOST_STEPS = 4000, 20_000
"""Validation rows that are ranked at most, in large and in small catalogues …"""
_SCORES = 2e8
"""… and in between, as many as have so many scores. Few rows say little where hits are rare."""
_HALVINGS = 3
"""How often the interval between the best reward weight and the next larger one is halved."""
_PRIOR = 10.0
"""Impressions at the mean rate that are added to those of an item."""


def choose_by_ranking(problem: Problem) -> RuleChoice:
    """Choose the reward weight of the rule; its other parts stay.

    Of those with enough overlap, the one with the highest rate is chosen, and of those whose rates
    cannot be distinguished the one with the most hits; without any, those count whose hits cannot
    be distinguished from the most. If the next larger of the candidates overlaps too little, reward
    weights between the two are tried. The first candidates are the configured ones; of many
    validation rows, 4,000 to 20,000 are drawn.
    """
    scorer, candidates = problem.scorer, list[_Candidate]()
    rows = _Rows.of(problem.train, problem.validation, problem.seed)
    scores = LoggedScores(scorer, rows.store, rows.episodes, rows.steps)

    def rank(weights: Sequence[float]) -> _Candidate:
        for weight, top in zip(weights, _top_items(scorer, weights, scores), strict=True):
            rule = replace(scorer.rule, reward_weight=weight)
            candidates.append(_Candidate.of(rule, top, rows))
        return _best(candidates)

    best = rank(sorted({0.0, *problem.config.reward_weights}))
    for _ in range(_HALVINGS):
        weight = best.weight
        larger = [candidate for candidate in candidates if candidate.weight > weight]
        nearest = min(larger, key=lambda candidate: candidate.weight, default=best)
        if nearest.overlaps:
            break
        best = rank([(weight + nearest.weight) / 2])
    halves = [
        _best([candidate.select(rows.users % 2 == half) for candidate in candidates]).weight
        for half in (0, 1)
    ]
    return RuleChoice(
        rule=best.rule,
        chosen_by="mean rate, on validation rows, of the ten items shown, among rules that find "
        "liked items better than the ten most liked ones do, by a standard error; no propensities "
        f"are used; halves of the users choose reward weights {halves[0]:g} and {halves[1]:g}",
        candidates=[candidate.summary for candidate in candidates],
        warning=""
        if best.overlaps
        else "; WARNING: no candidate does, this one is among those with the most hits",
        details={"reward_weights_of_halves": halves},
    )


@dataclass(frozen=True)
class _Rows:
    """M validation rows: where they are, what was shown and liked, what the baseline hits."""

    store: EpisodeStore
    users: IntArray
    """(M,) numbers of their users, or sessions where users are not named."""
    episodes: IntArray
    steps: IntArray
    items: IntArray
    liked: BoolArray
    baseline: BoolArray
    """Whether the item is one of the most liked training items."""
    rates: Float64Array
    """(n_items,) share of liked impressions of every item in the period, with ten at the mean."""

    @classmethod
    def of(cls, train: EpisodeStore, validation: EpisodeStore, seed: int) -> "_Rows":
        numbers = np.arange(validation.n_steps)
        most = int(np.clip(_SCORES / len(train.item_states.embeddings), _FEWEST_STEPS, _MOST_STEPS))
        if len(numbers) > most:
            numbers = np.random.default_rng(seed).choice(len(numbers), most, replace=False)
            numbers.sort()
        episodes, steps = validation.locate(numbers)
        items = validation.step_values(schema.ITEM, episodes, steps).astype(np.int64)
        rewards = validation.step_values(schema.REWARD, episodes, steps)
        counts = TrainingCounts.of(validation)
        impressions, likes = counts.shown.double().numpy(), counts.liked.double().numpy()
        rates = (likes + _PRIOR * likes.sum() / impressions.sum()) / (impressions + _PRIOR)
        users = episodes
        if validation.has_users:
            users = validation.episode_values(schema.USER).astype(np.int64)[episodes]
        most_liked = TrainingCounts.of(train).liked.topk(min(SHOWN, len(rates))).indices.numpy()
        return cls(
            store=validation,
            users=users,
            episodes=episodes,
            steps=steps,
            items=items,
            liked=liked_rewards(validation, rewards),
            baseline=np.isin(items, most_liked),
            rates=rates,
        )


@dataclass(frozen=True)
class _Candidate:
    """A rule, and what it would have shown in M rows."""

    rule: DecisionRule
    users: IntArray
    """(M,) whose rows they are."""
    rates: Float64Array
    """(M,) mean rate of the items shown."""
    liked: BoolArray
    """(M,)."""
    hits: BoolArray
    """(M,) whether the row's item is among those shown."""
    ahead: Float64Array
    """(M,) 1 for a liked item that only the rule shows, −1 for one that only the baseline does."""

    @classmethod
    def of(cls, rule: DecisionRule, top: IntArray, rows: _Rows) -> "_Candidate":
        hits = (top == rows.items[:, None]).any(1)
        ahead = (hits.astype(np.float64) - rows.baseline) * rows.liked
        return cls(rule, rows.users, rows.rates[top].mean(1), rows.liked, hits, ahead)

    def select(self, rows: BoolArray) -> "_Candidate":
        names = ("users", "rates", "liked", "hits", "ahead")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def weight(self) -> float:
        return self.rule.reward_weight

    @cached_property
    def summary(self) -> RankedRule:
        count = max(1, int(self.liked.sum()))
        gain = float(self.ahead.sum()) / count
        residuals = self.ahead - gain * self.liked
        return RankedRule(
            rule=self.rule,
            item_rate=float(self.rates.mean()) if len(self.rates) else 0.0,
            hits=float(self.hits[self.liked].sum()) / count,
            gain=gain,
            gain_error=_error_of_sum(residuals, self.users) / count,
        )

    @property
    def overlaps(self) -> bool:
        """Whether it finds liked items better than the baseline."""
        return self.summary.gain >= self.summary.gain_error

    def levels_with(self, top: "_Candidate") -> bool:
        """Whether the rate is not below that of another rule by more than a standard error."""
        below = top.rates - self.rates
        return not len(below) or bool(
            below.sum() <= _error_of_sum(below - below.mean(), self.users)
        )


def _error_of_sum(values: Float64Array, users: IntArray) -> float:
    """Standard error of the sum of values (M,) of mean 0, whose rows depend within users."""
    return float(np.sqrt(np.square(np.bincount(users, values)).sum())) if len(users) else 0.0


def _best(candidates: Sequence[_Candidate]) -> _Candidate:
    """The rule to choose; if none overlaps enough, of those that hit as often as any."""
    allowed = [candidate for candidate in candidates if candidate.overlaps]
    if not allowed:
        most = max((candidate.summary for candidate in candidates), key=lambda rule: rule.gain)
        enough = most.gain - most.gain_error
        allowed = [candidate for candidate in candidates if candidate.summary.gain >= enough]
    top = max(allowed, key=lambda candidate: candidate.summary.item_rate)
    level = [candidate for candidate in allowed if candidate.levels_with(top)]
    return max(level, key=lambda candidate: candidate.summary.hits)


def _top_items(scorer: Scorer, weights: Sequence[float], scores: LoggedScores) -> list[IntArray]:
    """The items (M, `SHOWN`) that are shown with each reward weight."""
    rules = [replace(scorer.rule, reward_weight=weight) for weight in weights]
    tops = [
        [best_items(values, min(SHOWN, values.shape[1])) for values in batch]
        for _, batch in scores.of(rules)
    ]
    return [torch.cat(parts).numpy() for parts in zip(*tops, strict=True)]
