"""Ranking metrics on a later period: the rank of the items that users were shown or clicked.

At every step, the whole catalogue is ranked from what was known before the step; no negatives are
sampled (Krichene & Rendle, KDD 2020). What counts as liked (a click) can be said.
"""

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import best_items
from ucfrec.arrays import Array, BoolArray, Float64Array, IntArray
from ucfrec.episodes.states import LIKED, ItemStates, least_liked, liked_rewards
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.errors import InputError
from ucfrec.logs.engine import bind, engine, explain_errors
from ucfrec.logs.expressions import Expression
from ucfrec.logs.histories import FrameTable
from ucfrec.results.statistics import group_auc, resample_ratios

_SCORES_AT_ONCE = 2**24
_STEPS_AT_ONCE = 1024
_ROWS = "steps"


def describe_liked(states: ItemStates) -> str:
    """States which steps `liked_rewards` takes to be liked."""
    low, high = float(states.reward_low), float(states.reward_high)
    return (
        f"reward >= {least_liked(low, high):.4g} ({LIKED:.0%} of the way from {low:.4g}, the "
        f"lowest training reward, to {high:.4g}, the highest or two standard deviations above the "
        "mean, if that is less)"
    )


class LikedExpression:
    """A step is liked if a SQL expression over its `reward` is true; missing values are not."""

    def __init__(self, expression: Expression, reward: str = schema.REWARD) -> None:
        """`expression` is over the column `reward`, which the run's own name of it means, too."""
        self._expression = expression
        self._names = {schema.REWARD.casefold(): schema.REWARD}
        if reward.isidentifier():
            self._names.setdefault(reward.casefold(), reward)
        self._evaluate(np.zeros(1))  # so that an unusable expression is refused at once

    def __call__(self, store: EpisodeStore, rewards: Array) -> BoolArray:
        values, places = np.unique(rewards, return_inverse=True)
        # The shortest decimals: as float64, 0.7 of float32 would be less than 0.7.
        return self._evaluate(values.astype(str).astype(np.float64))[places]

    def __str__(self) -> str:
        return str(self._expression)

    def _evaluate(self, rewards: Array) -> BoolArray:
        source = Path(_ROWS)
        types = tuple((name, "DOUBLE") for name in self._names.values())
        table = FrameTable((source,), types)
        with engine((), None) as connection, explain_errors(connection, (table,)):
            connection.register(_ROWS, pa.table({name: rewards for name, _ in types}))
            sql, kind, *_ = bind(connection, table, "for --liked", self._expression)
            if kind != "BOOLEAN":
                raise InputError(
                    f"{self._expression.origin} {self._expression} is {kind}, not true or false; "
                    f"compare it with something, such as {schema.REWARD} >= 4"
                )
            rows = connection.sql(f"SELECT COALESCE({sql}, false) FROM {table.sql}").fetchall()
        return np.fromiter((liked for (liked,) in rows), dtype=bool, count=len(rewards))


@dataclass(frozen=True)
class Later:
    """The steps to rank, and what their users were shown before."""

    store: EpisodeStore
    """A log of items, perhaps with the earlier steps of its sessions; see `UserRows.continued`."""
    rows: UserRows
    """Of its N steps."""
    filter_seen: bool = False
    """Whether items are left out that the user has seen before the step, as in `recommend`."""

    def steps(self, numbers: IntArray, filter_seen: bool) -> "Steps":
        """The steps with the given numbers (B,)."""
        episodes, steps = self.store.locate(numbers)
        left_out = None
        if filter_seen:
            rows, items = self.rows.seen(numbers)
            left_out = torch.from_numpy(rows), torch.from_numpy(items)
        users = self._users[episodes]
        return Steps(self.store, self.rows, numbers, episodes, steps, users, left_out)

    def share_out_of_reach(self) -> float:
        """Share of the steps whose shown item is left out; 0 without `filter_seen`."""
        if not self.filter_seen:
            return 0.0
        items, lost = self.store.column(schema.ITEM).astype(np.int64), 0
        for begin in range(0, len(items), _STEPS_AT_ONCE):
            numbers = np.arange(begin, min(begin + _STEPS_AT_ONCE, len(items)))
            rows, seen = self.rows.seen(numbers)
            lost += len(np.unique(rows[seen == items[numbers][rows]]))
        return lost / len(items)

    @cached_property
    def _users(self) -> IntArray:
        return self.store.episode_values(schema.USER)


@dataclass(frozen=True)
class Steps:
    """B evaluated steps of a store, with their histories."""

    store: EpisodeStore
    rows: UserRows
    """Of the users."""
    numbers: IntArray
    """(B,) number of each step among those of the store."""
    episodes: IntArray
    """(B,) episode of each step, as an index into the store."""
    steps: IntArray
    """(B,) position of each step in its episode, from 0."""
    users: IntArray
    """(B,) row of each step's user in the training store; −1 for users that it lacks."""
    left_out: tuple[Tensor, Tensor] | None = None
    """Rows (M,) and items (M,) that may not be recommended; None to rank all items."""


Ranker = Callable[[Steps], Tensor]
"""Scores all items at B steps (B, n_items), higher is better; (1, n_items) if they are the same."""


@dataclass(frozen=True)
class Ranked:
    """One ranker's results at N evaluated steps."""

    scores: Float64Array
    """(N,) score of the shown item at its user's first evaluated step: scores at the steps
    themselves would depend on the very rewards that they are compared by."""
    top: IntArray
    """(N, k) recommended items, best first; −1 where too few are left."""


@torch.no_grad()
def rank_steps(ranker: Ranker, later: Later, k: int) -> Ranked:
    """Rank every step of a later log: `k` items, at most n_items."""
    store, n_items = later.store, len(later.store.item_states.embeddings)
    at_once = max(1, min(_STEPS_AT_ONCE, _SCORES_AT_ONCE // n_items))
    parts = []
    for begin in range(0, store.n_steps, at_once):
        numbers = np.arange(begin, min(begin + at_once, store.n_steps))
        batch = later.steps(numbers, later.filter_seen)
        scores = ranker(batch)
        if batch.left_out is not None:
            scores = scores.expand(len(numbers), n_items).clone()
            scores[batch.left_out] = -torch.inf
        if (offer := store.offer(batch.episodes, batch.steps)) is not None:
            scores = scores.masked_fill(~offer.mask(), -torch.inf)
        top = best_items(scores, k)
        listed_items = top.masked_fill(torch.isneginf(scores.gather(1, top)), -1)
        parts.append(listed_items.expand(len(numbers), k).numpy())
    return Ranked(_first_scores(ranker, later, at_once), np.concatenate(parts))


def _first_scores(ranker: Ranker, later: Later, at_once: int) -> Float64Array:
    """(N,) score of each step's item at the first step of its user."""
    _, first, owner = np.unique(later.rows.first, return_index=True, return_inverse=True)
    items = later.store.column(schema.ITEM).astype(np.int64)
    order = np.argsort(owner, kind="stable")
    bounds = np.searchsorted(owner[order], np.arange(len(first) + 1))
    result = np.empty(len(owner))
    for begin in range(0, len(first), at_once):
        at = first[begin : begin + at_once]
        scores = ranker(later.steps(at, filter_seen=False))
        rows = order[bounds[begin] : bounds[begin + len(at)]]
        of_user = (owner[rows] - begin) % len(scores)
        result[rows] = scores.double().numpy()[of_user, items[rows]]
    return result


@dataclass(frozen=True)
class Period:
    """The N evaluated steps: the items shown and whether they were liked."""

    users: Array
    """(N,) identifier of each step's user."""
    items: IntArray
    """(N,) items shown."""
    liked: BoolArray
    """(N,) true at liked steps."""
    n_items: int

    @classmethod
    def of(
        cls,
        store: EpisodeStore,
        users: Array,
        liked: Callable[[EpisodeStore, Array], BoolArray] = liked_rewards,
    ) -> "Period":
        """The steps of `store`; `users` (E,) are the user identifiers of its E episodes, and
        `liked` says of steps, by their rewards, whether they were liked."""
        n_items, episodes = len(store.item_states.embeddings), store.all_steps()[0]
        items = store.column(schema.ITEM).astype(np.int64)
        return cls(users[episodes], items, liked(store, store.column(schema.REWARD)), n_items)


MEASURES: Mapping[str, str] = {
    "hit_rate_shown": "share of steps whose shown item is among the k recommended",
    "ndcg_shown": "mean over steps of 1 / log2(1 + rank) of the shown item, 0 if it is not among "
    "the k recommended",
    "hit_rate_liked": "hit_rate_shown over liked steps only",
    "ndcg_liked": "ndcg_shown over liked steps only",
    "recall_liked": "share of the items that a user liked in the period that are among the k "
    "recommended at the user's first step, mean over users",
    "gauc": "probability that a liked item scores higher than another one shown to the same user, "
    "from what was known before the user's first step, mean over users weighted by impressions",
    "item_rate": "mean share of liked impressions, in the period, of the recommended items that "
    "the period showed",
    "known": "share of recommended items that the period showed",
}
"""Description of each measure. Every measure is a ratio of sums over users, so that users can be
resampled."""


def measure(period: Period, ranked: Ranked) -> dict[str, tuple[Float64Array, Float64Array]]:
    """By measure, numerators and denominators (U,) per user; its value is Σ above / Σ below."""
    users, owner = np.unique(period.users, return_inverse=True)
    matches = ranked.top == period.items[:, None]
    hit = matches.any(axis=1)
    gain = (matches / np.log2(2 + np.arange(matches.shape[1]))).sum(axis=1)
    every = np.ones(len(owner))
    liked = period.liked.astype(np.float64)
    counted = np.bincount(period.items, minlength=period.n_items)
    rates = np.bincount(period.items, liked, period.n_items)
    with np.errstate(invalid="ignore"):
        rates = np.append(rates / counted, np.nan)[ranked.top]  # −1: no item
    n_known = (~np.isnan(rates)).sum(1)
    # Of each item that a user liked: whether it is recommended at the user's first step.
    liked_pairs = np.unique(np.stack([owner, period.items])[:, period.liked], axis=1)
    first = np.unique(owner, return_index=True)[1]
    users_of, items_of = liked_pairs
    in_top = (ranked.top[first[users_of]] == items_of[:, None]).any(axis=1)
    n_liked = np.bincount(users_of, minlength=len(users))
    recalled = np.bincount(users_of, in_top, len(users)) / np.maximum(n_liked, 1)
    by_step = {
        "hit_rate_shown": (hit, every),
        "ndcg_shown": (gain, every),
        "hit_rate_liked": (hit * liked, liked),
        "ndcg_liked": (gain * liked, liked),
        "item_rate": (np.nansum(rates, axis=1), n_known),
        "known": (n_known, (ranked.top >= 0).sum(1)),
    }
    sums = {
        "recall_liked": (recalled, (n_liked > 0).astype(np.float64)),
        "gauc": group_auc(ranked.scores, period.liked, owner, len(users)),
    }
    for name, values in by_step.items():
        above, below = (np.bincount(owner, column).astype(np.float64) for column in values)
        sums[name] = above, below
    return {name: sums[name] for name in MEASURES}


def compare(
    period: Period,
    ranked: Mapping[str, Ranked],
    reference: str,
    seed: int,
) -> dict[str, dict[str, Any]]:
    """By ranker (name: results), the value of each measure; `intervals`, the ends of their 95%
    intervals (percentile bootstrap over users); `differences` from `reference`, each with the ends
    of its interval, of the same draws of users for all; and `coverage`, the share of the
    catalogue's items that are recommended at one step or more.
    """
    measured = [[*measure(period, entry).values()] for entry in ranked.values()]
    # (U, rankers, measures), so that one draw of users serves all rankers.
    above, below = np.ascontiguousarray(np.transpose(measured, (2, 3, 0, 1)))
    users = len(above)
    ratios = resample_ratios(above.reshape(users, -1), below.reshape(users, -1), seed)
    resampled = ratios.reshape((-1, *above.shape[1:]))
    with np.errstate(invalid="ignore"):
        values = above.sum(0) / below.sum(0)
    column = list(ranked).index(reference)
    ends = _find_ends(resampled)
    beyond = _find_ends(resampled - resampled[:, column : column + 1])
    differences = np.stack([values - values[column], *beyond])
    return {
        name: {
            **dict(zip(MEASURES, values[row].tolist(), strict=True)),
            "coverage": len(np.setdiff1d(entry.top, [-1])) / period.n_items,
            "intervals": dict(zip(MEASURES, ends[:, row].T.tolist(), strict=True)),
            "differences": dict(zip(MEASURES, differences[:, row].T.tolist(), strict=True)),
        }
        for row, (name, entry) in enumerate(ranked.items())
    }


def _find_ends(resampled: Float64Array) -> Float64Array:
    """Ends (2, rankers, measures) of the 95% intervals; NaN if all resampled ratios are NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanquantile(resampled, [0.025, 0.975], axis=0)


def name_rankers(rankers: Iterable[tuple[str, Ranker]]) -> dict[str, Ranker]:
    """The rankers by name; of equal names, the second and later ones get a suffix -2, -3, …"""
    by_name: dict[str, Ranker] = {}
    for title, ranker in rankers:
        name, number = title, 2
        while name in by_name:
            name, number = f"{title}-{number}", number + 1
        by_name[name] = ranker
    return by_name
