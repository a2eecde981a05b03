"""Choose the reward weight of a run by how it ranks the validation rows of its log.

Where the log has no true sessions there is nothing to simulate, but every row tells what a user
liked.
A candidate is worth the mean rate, in the validation period, of the ten items that it would show,
and overlaps with the log enough if it finds liked items no worse than the ten most liked ones do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer, logged_history
from ucfrec.arrays import BoolArray, Float64Array, IntArray
from ucfrec.choosing.choice import RankedRule, RuleChoice
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


def choose_by_ranking(
    scorer: Scorer, train: EpisodeStore, validation: EpisodeStore, config: RuleConfig, seed: int
) -> RuleChoice:
    """Choose the reward weight of the rule of `scorer`; its other parts stay.

    Of those with enough overlap, the one with the highest rate is chosen; without any, none. If
    the next larger of the candidates overlaps too little, reward weights between the two are tried.
    The arguments are those of `ucfrec.choosing.choose.choose_rule`; `config.reward_weights` are the
    first candidates, and `seed` is of the validation rows that are drawn from more than 4,000.
    """
    rows = _Rows.of(train, validation, seed)
    candidates: list[RankedRule] = []

    def rank(weights: Sequence[float]) -> RankedRule:
        for weight, top in zip(weights, _tops(scorer, weights, rows), strict=True):
            rule = replace(scorer.rule, reward_weight=weight)
            candidates.append(_ranked(rule, top, rows))
        allowed = [each for each in candidates if each.gain >= 0]
        return max(allowed, key=lambda each: each.item_rate) if allowed else candidates[0]

    best = rank(sorted({0.0, *config.reward_weights}))
    for _ in range(_HALVINGS):
        weight = best.rule.reward_weight
        larger = [each for each in candidates if each.rule.reward_weight > weight]
        nearest = min(larger, key=lambda each: each.rule.reward_weight, default=best)
        if nearest.gain >= 0:
            break
        best = rank([(weight + nearest.rule.reward_weight) / 2])
    return RuleChoice(
        rule=best.rule,
        chosen_by="mean rate, on validation rows, of the ten items shown, among rules that find "
        "liked items no worse than the ten most liked ones do; no propensities are used",
        candidates=candidates,
        warning=""
        if best.gain >= 0
        else "; WARNING: no candidate does, this one has no reward weight",
    )


@dataclass(frozen=True)
class _Rows:
    """M validation rows: where they are, what was shown and liked, what the baseline hits."""

    store: EpisodeStore
    episodes: IntArray
    steps: IntArray
    items: IntArray
    liked: BoolArray
    baseline: BoolArray
    """Whether the item is one of the most liked training items."""
    rates: Float64Array
    """(n_items,) share of liked impressions of every item in the period; NaN if never shown."""

    @classmethod
    def of(cls, train: EpisodeStore, validation: EpisodeStore, seed: int) -> "_Rows":
        numbers = np.arange(validation.n_steps)
        if len(numbers) > _MOST_STEPS:
            drawn = np.random.default_rng(seed).choice(len(numbers), _MOST_STEPS, replace=False)
            numbers = np.sort(drawn)
        episodes, steps = validation.locate(numbers)
        items = validation.step_values(schema.ITEM, episodes, steps).astype(np.int64)
        counts = TrainingCounts.of(validation)
        shown, liked = counts.shown.double().numpy(), counts.liked.double().numpy()
        with np.errstate(invalid="ignore"):
            rates = liked / np.where(shown > 0, shown, np.nan)
        most_liked = TrainingCounts.of(train).liked.topk(min(SHOWN, len(rates))).indices.numpy()
        return cls(
            *(validation, episodes, steps, items, liked_steps(validation, episodes, steps)),
            *(np.isin(items, most_liked), rates),
        )


@torch.no_grad()
def _tops(scorer: Scorer, reward_weights: Sequence[float], rows: _Rows) -> list[IntArray]:
    """The items (M, `SHOWN`) that are shown with each reward weight.

    Policy and reward model are computed once for all reward weights.
    """
    scorers = [scorer.under(replace(scorer.rule, reward_weight=each)) for each in reward_weights]
    tops = list[list[Tensor]]()
    with progress(len(rows.steps), "choose the rule", "rows") as bar:
        for first in range(0, len(rows.steps), _AT_ONCE):
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
    ahead = hit - rows.baseline[rows.liked]
    shown = rows.rates[top]
    some = len(hit) > 0
    return RankedRule(
        rule=rule,
        item_rate=float(np.nanmean(shown)) if np.isfinite(shown).any() else 0.0,
        hits=float(hit.mean()) if some else 0.0,
        gain=float(ahead.mean()) if some else 0.0,
        gain_error=float(ahead.std() / len(ahead) ** 0.5) if some else 0.0,
    )
