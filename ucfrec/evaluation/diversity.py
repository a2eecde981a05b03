"""What sessions were made of: coverage, diversity, novelty, dominance (EasyRL4Rec, DORL)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ucfrec.acting.rollout import BoolArray, IntArray, Step

Similarity = Callable[[IntArray, IntArray], npt.NDArray[np.floating]]
"""Of items (M,) and items (M,), aligned: (M,), 1 for equal items."""


@dataclass
class Recommended:
    """Items of every episode, collected by `rollout(…, on_step=recommended.record)`."""

    _episodes: list[IntArray] = field(default_factory=list)
    _items: list[IntArray] = field(default_factory=list)

    def record(self, step: Step) -> None:
        """Note one step."""
        self._episodes.append(step.episodes)
        self._items.append(step.actions)

    def sessions(self) -> tuple[IntArray, IntArray]:
        """(episodes, items) of all steps, (M,) each, episode by episode in the order played."""
        episodes = np.concatenate(self._episodes)
        order = np.argsort(episodes, kind="stable")
        return episodes[order], np.concatenate(self._items)[order]


def coverage(items: IntArray, n_items: int) -> float:
    """CV: share of the catalogue that was recommended at all."""
    return len(np.unique(items)) / n_items


def coverage_per_turn(items: IntArray) -> float:
    """CV_turn: different items over recommendations."""
    return len(np.unique(items)) / len(items)


def diversity(episodes: IntArray, items: IntArray, similarity: Similarity) -> float:
    """Mean over episodes of the mean of 1 − similarity over their pairs; 1 for a single item.

    Args:
        episodes: (M,) sorted, at least one step.
        items: (M,).
    """
    _, starts, lengths = np.unique(episodes, return_index=True, return_counts=True)
    # Every step pairs with all later ones of its episode, so no episode needs a turn of its own.
    last = np.repeat(starts + lengths, lengths)
    later = last - np.arange(len(items)) - 1
    first = np.repeat(np.arange(len(items)), later)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(later) - later, later)
    distances = 1.0 - similarity(items[first], items[second])
    owner = np.searchsorted(starts, first, side="right") - 1
    total = np.bincount(owner, weights=distances, minlength=len(starts))
    pairs = lengths * (lengths - 1) / 2
    return float(np.where(lengths > 1, total / np.maximum(pairs, 1), 1.0).mean())


def tag_jaccard(incidence: BoolArray) -> Similarity:
    """Shared tags over all tags of two items, of a table (n_items, n_tags); 0 without any."""

    def similarity(one: IntArray, other: IntArray) -> npt.NDArray[np.floating]:
        shared = (incidence[one] & incidence[other]).sum(axis=1)
        either = (incidence[one] | incidence[other]).sum(axis=1)
        return np.where(one == other, 1.0, shared / np.maximum(either, 1))

    return similarity


def novelty(items: IntArray, popularity: npt.NDArray[np.floating]) -> float:
    """Mean of −ln(popularity) of what was recommended; items without any count as the rarest one.

    Args:
        popularity: (n_items,) interactions over users, some above 0.
    """
    some = popularity[popularity > 0].min()
    return float(-np.log(np.maximum(popularity, some))[items].mean())


def dominant_tags(incidence: BoolArray, positives: IntArray, share: float = 0.8) -> BoolArray:
    """(n_tags,) which tags dominate: the most frequent, as long as they cover at most `share`.

    Args:
        incidence: (n_items, n_tags).
        positives: (n_items,) positive interactions of the training log; each counts once for every
            tag of its item.
        share: of all those counts.
    """
    counts = positives @ incidence.astype(np.int64)
    order = np.argsort(-counts, kind="stable")
    covered = np.cumsum(counts[order]) / max(counts.sum(), 1)
    dominant = np.zeros(len(counts), dtype=np.bool_)
    dominant[order[covered <= share]] = True
    return dominant


def dominance(items: IntArray, incidence: BoolArray, dominant: BoolArray) -> float:
    """MCD: share of recommendations that carry a dominant tag."""
    return float(incidence[items][:, dominant].any(axis=1).mean())
