"""Choose the reward weight of a run by how it ranks the validation rows of its log.

Where the log has no true sessions there is nothing to play, but every row tells what a user liked.
A candidate is worth the mean rate, in the validation period, of the ten items that it would show,
and overlaps with the log enough if it finds liked items no worse than the ten most liked ones do.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer, logged_history
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.choosing.config import RuleConfig
from ucfrec.episodes.item_counts import TrainingCounts, liked_steps
from ucfrec.episodes.store import EpisodeStore
from ucfrec.progress import progress

SHOWN = 10
"""Items that a rule shows at a step."""
_MOST_STEPS = 4000
"""Validation rows that are ranked at most."""
_HALVINGS = 3
"""How often the interval between the best reward weight and the next larger one is halved."""
_AT_ONCE = 256


@dataclass(frozen=True)
class RankedRule:
    """A rule and how it ranks validation rows."""

    rule: DecisionRule
    item_rate: float
    """Mean share of liked impressions, in the validation period, of the items shown."""
    hits: float
    """Share of liked validation rows whose item is among those shown."""
    gain: float
    """Difference of `hits` from that of the most liked training items."""
    gain_error: float
    """Its standard error over rows."""

    def as_dict(self) -> dict[str, Any]:
        """As a JSON object; the rule's fields are those of `DecisionRule.as_dict`."""
        return {**asdict(self), "rule": self.rule.as_dict()}


@dataclass(frozen=True)
class RankedChoice:
    """The rule that was chosen, and all candidates."""

    rule: DecisionRule
    candidates: Sequence[RankedRule]
    supported: bool
    """Whether the rule finds liked items no worse than the ten most liked; if not, none does."""

    def as_dict(self) -> dict[str, Any]:
        """As a JSON object, with what chose the rule in words."""
        return {
            "rule": self.rule.as_dict(),
            "chosen_by": "mean rate, on validation rows, of the ten items shown, among rules that "
            "find liked items no worse than the ten most liked ones do; no propensities are used",
            "warning": ""
            if self.supported
            else "; WARNING: no candidate does, this one has no reward weight",
            "candidates": [candidate.as_dict() for candidate in self.candidates],
        }


def choose_by_ranking(
    scorer: Scorer, train: EpisodeStore, validation: EpisodeStore, config: RuleConfig, seed: int
) -> RankedChoice:
    """Choose the reward weight of the rule of `scorer`; its other parts stay.

    Args:
        scorer: the policy under its default rule, with a reward model.
        train: training episodes.
        validation: validation episodes.
        config: `reward_weights` are the first candidates.
        seed: of the validation rows that are drawn from more than 4,000.

    Returns:
        The reward weight with the highest rate among those with enough overlap; without any, no
        reward weight. If the next larger of the candidates overlaps too little, reward weights
        between the two are tried.
    """
    rows = np.arange(validation.n_steps)
    if len(rows) > _MOST_STEPS:
        drawn = np.random.default_rng(seed).choice(len(rows), _MOST_STEPS, replace=False)
        rows = np.sort(drawn)
    episodes, steps = validation.locate(rows)
    liked = liked_steps(validation, episodes, steps)
    items = validation.step_values(schema.ITEM, episodes, steps).astype(np.int64)
    rates = _rates(validation)
    most_liked = TrainingCounts.of(train).liked.topk(min(SHOWN, len(rates))).indices.numpy()
    floor = np.isin(items, most_liked)
    given = _Rows(validation, episodes, steps, items, liked, floor, rates)
    reward_weights = sorted({0.0, *config.reward_weights})
    candidates: list[RankedRule] = []

    def rank(reward_weights: Sequence[float]) -> None:
        for reward_weight, top in zip(
            reward_weights, _tops(scorer, reward_weights, given), strict=True
        ):
            candidates.append(
                _ranked(replace(scorer.rule, reward_weight=reward_weight), top, given)
            )

    rank(reward_weights)
    for _ in range(_HALVINGS):
        best = _best(candidates)
        larger = [each for each in candidates if each.rule.reward_weight > best.rule.reward_weight]
        nearest = min(larger, key=lambda each: each.rule.reward_weight, default=best)
        if nearest.gain >= 0:
            break
        rank([(best.rule.reward_weight + nearest.rule.reward_weight) / 2])
    best = _best(candidates)
    return RankedChoice(best.rule, candidates, best.gain >= 0)


def _best(candidates: Sequence[RankedRule]) -> RankedRule:
    """The candidate of the highest rate among those that overlap enough, or else the first."""
    allowed = [each for each in candidates if each.gain >= 0]
    return max(allowed, key=lambda each: each.item_rate) if allowed else candidates[0]


@dataclass(frozen=True)
class _Rows:
    """M validation rows: where they are, what was shown and liked, what the floor hits."""

    store: EpisodeStore
    episodes: IntArray
    steps: IntArray
    items: IntArray
    liked: BoolArray
    floor: BoolArray
    rates: Float64Array
    """(n_items,) of all items in the period."""


@torch.no_grad()
def _tops(scorer: Scorer, reward_weights: Sequence[float], rows: _Rows) -> list[IntArray]:
    """The items (M, `SHOWN`) that are shown with each reward weight.

    Policy and reward model are computed once for all reward weights.
    """
    scorers = [scorer.under(replace(scorer.rule, reward_weight=each)) for each in reward_weights]
    tops = list[list[Tensor]]()
    starts = range(0, len(rows.steps), _AT_ONCE)
    with progress(len(rows.steps), "choose the rule", "rows") as bar:
        for first in starts:
            part = slice(first, first + _AT_ONCE)
            episodes, steps = rows.episodes[part], rows.steps[part]
            known, seen = logged_history(scorer, rows.store, episodes, steps)
            history = scorer.with_target(known)
            query = scorer.query(history, rewards=any(reward_weights))
            scores = (each.scores_of(query, history, excluded=seen) for each in scorers)
            tops.append([each.topk(min(SHOWN, each.shape[1])).indices for each in scores])
            bar.update(len(steps))
    return [torch.cat(parts).numpy() for parts in zip(*tops, strict=True)]


def _ranked(rule: DecisionRule, top: IntArray, rows: _Rows) -> RankedRule:
    hit = (top == rows.items[:, None]).any(1)[rows.liked].astype(np.float64)
    ahead = hit - rows.floor[rows.liked]
    shown = rows.rates[top]
    some = len(hit) > 0
    return RankedRule(
        rule=rule,
        item_rate=float(np.nanmean(shown)) if np.isfinite(shown).any() else 0.0,
        hits=float(hit.mean()) if some else 0.0,
        gain=float(ahead.mean()) if some else 0.0,
        gain_error=float(ahead.std() / len(ahead) ** 0.5) if some else 0.0,
    )


def _rates(validation: EpisodeStore) -> Float64Array:
    """Share of liked impressions of each item in the period, (n_items,); NaN if never shown."""
    counts = TrainingCounts.of(validation)
    shown = counts.shown.double().numpy()
    with np.errstate(invalid="ignore"):
        return np.asarray(counts.liked.double().numpy() / np.where(shown > 0, shown, np.nan))
