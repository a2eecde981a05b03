"""Next-period ranking: how a policy ranks the items that users were shown, and clicked, later.

Every step is ranked over the whole catalogue from what was known before it; no negatives are
sampled (Krichene & Rendle, KDD 2020). A step counts as *liked* where its reward, scaled to [0, 1]
as in item states, is at least `ucfrec.episodes.item_counts.LIKED`: a click.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from scipy.stats import rankdata
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.item_counts import liked_steps
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.evaluation.metrics import resampled_ratios

_SCORES_AT_ONCE = 2**24
_STEPS_AT_ONCE = 1024

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Steps:
    """B judged steps and what was known before each."""

    store: EpisodeStore
    episodes: IntArray
    """(B,) positions in the store."""
    steps: IntArray
    """(B,)."""
    users: IntArray
    """(B,) row of each step's user in the training store; −1 for a user it does not know."""

    def windows(self, length: int) -> Windows:
        """The last `length` steps up to each judged one; its own action and reward are the last
        column's, which no ranker may read."""
        return self.store.windows(self.episodes, self.steps, length)


class Ranker(Protocol):
    """Anything that scores the catalogue at a step."""

    @property
    def name(self) -> str:
        """How result rows call it."""

    def scores(self, steps: Steps) -> Tensor:
        """(B, n_items): higher is better; (1, n_items) where all steps have the same."""


@dataclass(frozen=True)
class Ranked:
    """What one ranker made of N judged steps."""

    ranks: FloatArray
    """(N,) rank of the shown item, from 1; ties share their mean rank."""
    scores: FloatArray
    """(N,) score of the shown item."""
    top: IntArray
    """(N, k) items that it would have shown, best first."""


def judged_steps(store: EpisodeStore, at_once: int) -> Iterator[Steps]:
    """Every step of `store` in order, `at_once` at a time."""
    users = store.episode_values(schema.USER).astype(np.int64)
    for begin in range(0, store.n_steps, at_once):
        numbers = np.arange(begin, min(begin + at_once, store.n_steps))
        episodes, steps = store.locate(numbers)
        yield Steps(store, episodes, steps, users[episodes])


@torch.no_grad()
def rank_steps(ranker: Ranker, store: EpisodeStore, k: int) -> Ranked:
    """Rank every step of `store`.

    Args:
        k: items that are recommended at a step.
    """
    n_items = len(store.item_states.embeddings)
    at_once = max(1, min(_STEPS_AT_ONCE, _SCORES_AT_ONCE // n_items))
    parts = []
    for batch in judged_steps(store, at_once):
        shown = store.step_values(schema.ITEM, batch.episodes, batch.steps).astype(np.int64)
        scores = ranker.scores(batch)
        if len(scores) == 1:
            parts.append(_ranked_alike(scores[0], torch.from_numpy(shown), k))
        else:
            parts.append(_ranked(scores, torch.from_numpy(shown), k))
    return Ranked(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _ranked(scores: Tensor, shown: Tensor, k: int) -> tuple[FloatArray, FloatArray, IntArray]:
    own = scores.gather(1, shown.unsqueeze(1))
    above, equal = (scores > own).sum(1), (scores == own).sum(1)
    ranks = 1 + above.double() + (equal - 1).double() / 2
    return ranks.numpy(), own[:, 0].double().numpy(), scores.topk(k, dim=1).indices.numpy()


def _ranked_alike(scores: Tensor, shown: Tensor, k: int) -> tuple[FloatArray, FloatArray, IntArray]:
    """The same where all steps have the scores (n_items,): they are sorted once."""
    ranks = rankdata(-scores.double().numpy(), method="average")
    top = np.broadcast_to(scores.topk(k).indices.numpy(), (len(shown), k))
    return ranks[shown], scores[shown].double().numpy(), top


@dataclass(frozen=True)
class Period:
    """The judged steps: what every ranker is compared with."""

    users: npt.NDArray[Any]
    """(N,) identifier of each step's user."""
    items: IntArray
    """(N,) items shown."""
    liked: npt.NDArray[np.bool_]
    """(N,)."""
    n_items: int

    @classmethod
    def of(cls, store: EpisodeStore, users: npt.NDArray[Any]) -> "Period":
        """All steps of `store`, `users` (E,) being the identifier of each episode's user."""
        episodes, steps = store.all_steps()
        items = store.step_values(schema.ITEM, episodes, steps).astype(np.int64)
        n_items = len(store.item_states.embeddings)
        return cls(users[episodes], items, liked_steps(store, episodes, steps), n_items)

    @property
    def item_rates(self) -> FloatArray:
        """(n_items,) share of the period's impressions of an item that were liked; NaN where it
        was never shown."""
        shown = np.bincount(self.items, minlength=self.n_items)
        liked = np.bincount(self.items, self.liked, minlength=self.n_items)
        with np.errstate(invalid="ignore"):
            return np.asarray(liked / np.where(shown > 0, shown, np.nan))


MEASURES: Mapping[str, str] = {
    "hit_rate_shown": "share of steps whose shown item is among the k recommended",
    "ndcg_shown": "1 / log2(1 + rank) of the shown item where it is among the k, mean of steps",
    "hit_rate_liked": "the first, of liked steps only",
    "ndcg_liked": "the second, of liked steps only",
    "recall_liked": "share of a user's liked items of the period that are among the k recommended "
    "at the user's first step",
    "gauc": "probability that a liked step scores above another of the same user, by impressions",
    "item_rate": "share of likes in the period of the items recommended, those it showed",
    "known": "share of recommended items that the period showed",
}
"""What each measure is; a mean of users' sums, so that intervals are by user."""


def measure(period: Period, ranked: Ranked, k: int) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Every measure as (above, below), (U,) each, by user: its value is Σ above / Σ below."""
    users, owner = np.unique(period.users, return_inverse=True)
    hit = ranked.ranks <= k
    gain = hit / np.log2(1 + ranked.ranks)

    def by_user(values: npt.NDArray[Any]) -> FloatArray:
        return np.bincount(owner, values, minlength=len(users)).astype(np.float64)

    every, liked = np.ones(len(owner)), period.liked.astype(np.float64)
    rates = period.item_rates[ranked.top]
    known = ~np.isnan(rates)
    return {
        "hit_rate_shown": (by_user(hit), by_user(every)),
        "ndcg_shown": (by_user(gain), by_user(every)),
        "hit_rate_liked": (by_user(hit * liked), by_user(liked)),
        "ndcg_liked": (by_user(gain * liked), by_user(liked)),
        "recall_liked": _recall(period, ranked, owner, len(users)),
        "gauc": _group_auc(ranked.scores, period.liked, owner, len(users)),
        "item_rate": (by_user(np.nansum(rates, axis=1)), by_user(known.sum(1))),
        "known": (by_user(known.sum(1)), by_user(every * ranked.top.shape[1])),
    }


def _recall(
    period: Period, ranked: Ranked, owner: IntArray, n_users: int
) -> tuple[FloatArray, FloatArray]:
    """Of each user with liked items: the share of them recommended at the first step; and 1."""
    pairs = np.unique(np.stack([owner, period.items])[:, period.liked], axis=1)
    # Steps are in order of user and time: the first of a user is where `owner` first says so.
    first = np.full(n_users, len(owner))
    np.minimum.at(first, owner, np.arange(len(owner)))
    found = (ranked.top[first[pairs[0]]] == pairs[1][:, None]).any(1)
    wanted = np.bincount(pairs[0], minlength=n_users)
    with np.errstate(invalid="ignore"):
        share = np.nan_to_num(np.bincount(pairs[0], found, minlength=n_users) / wanted)
    return share, (wanted > 0).astype(np.float64)


def _group_auc(
    scores: FloatArray, liked: npt.NDArray[np.bool_], owner: IntArray, n_users: int
) -> tuple[FloatArray, FloatArray]:
    """Each user's AUC times impressions, and impressions, of users with both kinds of step
    (Zhu et al., KDD 2017)."""
    sizes = np.bincount(owner, minlength=n_users)
    _, place = np.unique(scores, return_inverse=True)
    # Ranks within users: those of (user, score) less the steps of the users before.
    ranks = rankdata(owner * len(scores) + place) - (np.cumsum(sizes) - sizes)[owner]
    positive = np.bincount(owner, liked, minlength=n_users)
    negative = sizes - positive
    above = np.bincount(owner, ranks * liked, minlength=n_users) - positive * (positive + 1) / 2
    mixed = (positive > 0) & (negative > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        auc = np.where(mixed, above / (positive * negative), 0.0)
    weight = (sizes * mixed).astype(np.float64)
    return auc * weight, weight


@dataclass(frozen=True)
class Compared:
    """One ranker's measures."""

    name: str
    values: Mapping[str, float]
    intervals: Mapping[str, Sequence[float]]
    """95%, by a bootstrap over users."""
    differences: Mapping[str, Sequence[float]]
    """Value less the reference's with its 95% interval, the same users drawn for both."""
    coverage: float
    """Share of the catalogue that is recommended at all."""


def compare(
    period: Period, ranked: Mapping[str, Ranked], k: int, reference: str, seed: int
) -> list[Compared]:
    """Measures of every ranker with intervals by user, and differences from `reference`.

    Args:
        ranked: by the ranker's name.
        reference: one of those names.
        seed: of the resampled users, the same for all rankers.
    """
    measured = [measure(period, own, k) for own in ranked.values()]
    # (U, rankers, measures): users are drawn once for all rankers.
    above, below = (
        np.stack([np.stack([own[m][part] for m in MEASURES], axis=1) for own in measured], axis=1)
        for part in (0, 1)
    )
    drawn = resampled_ratios(_flat(above), _flat(below), seed).reshape(-1, *above.shape[1:])
    with np.errstate(invalid="ignore"):
        values = above.sum(0) / below.sum(0)
    at = list(ranked).index(reference)
    ends = _ends(drawn)
    differences = np.stack([values - values[at], *_ends(drawn - drawn[:, at : at + 1])])
    return [
        Compared(
            name,
            dict(zip(MEASURES, values[row].tolist(), strict=True)),
            dict(zip(MEASURES, ends[:, row].T.tolist(), strict=True)),
            dict(zip(MEASURES, differences[:, row].T.tolist(), strict=True)),
            len(np.unique(own.top)) / period.n_items,
        )
        for row, (name, own) in enumerate(ranked.items())
    ]


def _flat(values: FloatArray) -> FloatArray:
    return values.reshape(len(values), -1)


def _ends(drawn: FloatArray) -> FloatArray:
    """(2, rankers, measures) ends of the 95% percentile intervals; NaN where nothing was drawn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanquantile(drawn, [0.025, 0.975], axis=0))


def rankers_named(rankers: Sequence[Ranker]) -> dict[str, Ranker]:
    """By name, numbered from the second of a name on."""
    named: dict[str, Ranker] = {}
    for ranker in rankers:
        name, again = ranker.name, 2
        while name in named:
            name, again = f"{ranker.name}-{again}", again + 1
        named[name] = ranker
    return named
