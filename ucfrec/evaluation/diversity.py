"""Coverage, diversity, novelty and dominance of recommended items (EasyRL4Rec, DORL)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from gymnasium.vector import VectorEnv

from ucfrec.acting.rollout import Step
from ucfrec.arrays import BoolArray, IntArray
from ucfrec.episodes.states import TrainingCounts
from ucfrec.evaluation.collect import Catalog, environment_items

Similarity = Callable[[IntArray, IntArray], npt.NDArray[np.floating]]
"""Similarity (M,) of two aligned arrays of items (M,), at most 1; equal items have 1."""
TAGS = "tags"
"""Catalogue column with the list of each item's tags."""
ONE_HOT = "tag_"
"""Prefix of catalogue columns, one per tag, that are above 0 for items with the tag."""
COLUMNS = (
    "coverage", "coverage_per_turn", "diversity", "novelty", "majority_category_dominance",
)  # fmt: skip


@dataclass
class Recommended:
    """The recommended items of all episodes, collected by `rollout(…, on_step=self.record)`."""

    _episodes: list[IntArray] = field(default_factory=list)
    _items: list[IntArray] = field(default_factory=list)

    def record(self, step: Step) -> None:
        """Add one step."""
        self._episodes.append(step.episodes)
        self._items.append(step.actions)

    def sessions(self) -> tuple[IntArray, IntArray]:
        """Episode index (M,) and item (M,) of all steps, sorted by episode and then by step."""
        episodes = np.concatenate(self._episodes)
        order = np.argsort(episodes, kind="stable")
        return episodes[order], np.concatenate(self._items)[order]


def coverage(items: IntArray, n_items: int) -> float:
    """CV: share of the `n_items` items of the catalogue that occur in `items` (M,)."""
    return len(np.unique(items)) / n_items


def coverage_per_turn(items: IntArray) -> float:
    """CV_turn: number of distinct items in `items` (M,), divided by M."""
    return len(np.unique(items)) / len(items)


def diversity(episodes: IntArray, items: IntArray, similarity: Similarity) -> float:
    """Mean over episodes of the mean of 1 − similarity over pairs of steps; 1 for a single step.

    Args:
        episodes: (M,) sorted episode indices, M at least 1.
        items: (M,) the items of these steps.
    """
    _, starts, lengths = np.unique(episodes, return_index=True, return_counts=True)
    # Pairs of all episodes are enumerated at once: each step with all later ones of its episode.
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
    """Jaccard similarity of two items' tags, from `incidence` (n_items, n_tags); 0 without tags."""

    def similarity(one: IntArray, other: IntArray) -> npt.NDArray[np.floating]:
        shared = (incidence[one] & incidence[other]).sum(axis=1)
        either = (incidence[one] | incidence[other]).sum(axis=1)
        return np.where(one == other, 1.0, shared / np.maximum(either, 1))

    return similarity


def novelty(items: IntArray, popularity: npt.NDArray[np.floating]) -> float:
    """Mean of −ln(popularity) over recommendations, in nats.

    An item with popularity 0 counts as the least popular item above 0.

    Args:
        items: (M,) recommended items.
        popularity: (n_items,) interactions divided by users, at least one above 0.
    """
    lowest = popularity[popularity > 0].min()
    return float(-np.log(np.maximum(popularity, lowest))[items].mean())


def dominant_tags(incidence: BoolArray, positives: IntArray, share: float = 0.8) -> BoolArray:
    """Dominant tags (n_tags,): the most frequent ones that together cover at most `share`.

    The most frequent one is always dominant, if it counts at all.

    Args:
        incidence: (n_items, n_tags).
        positives: (n_items,) numbers of positive interactions in the training log; each counts
            once for every tag of its item.
        share: share of the sum of all tags' counts.
    """
    counts = positives @ incidence.astype(np.int64)
    order = np.argsort(-counts, kind="stable")
    covered = np.cumsum(counts[order]) / max(counts.sum(), 1)
    frequent = covered <= share
    frequent[:1] = True
    dominant = np.zeros(len(counts), dtype=np.bool_)
    dominant[order[frequent]] = True
    return dominant & (counts > 0)


def dominance(items: IntArray, incidence: BoolArray, dominant: BoolArray) -> float:
    """MCD: share of recommendations `items` (M,) that have a dominant tag.

    Args:
        items: (M,) recommended items.
        incidence: (n_items, n_tags).
        dominant: (n_tags,) from `dominant_tags`.
    """
    return float(incidence[items][:, dominant].any(axis=1).mean())


def variety_columns(
    env: VectorEnv[Any, Any, Any],
    recommended: Recommended,
    counts: TrainingCounts | None = None,
    numbers: IntArray | None = None,
) -> dict[str, float | None]:
    """The `COLUMNS`; a metric whose inputs are missing is None.

    Diversity (tag Jaccard) and dominance need a catalogue with tags; novelty and dominance need
    `counts` and `numbers`, which built-in policies do not have.

    Args:
        recommended: the items of all steps.
        numbers: (items of the log,) the environment's index of each item, −1 for items that it
            lacks.
    """
    episodes, items = recommended.sessions()
    n_items = len(environment_items(env))
    row: dict[str, float | None] = dict.fromkeys(COLUMNS)
    row["coverage"] = coverage(items, n_items)
    row["coverage_per_turn"] = coverage_per_turn(items)
    incidence = _incidence(env)
    if incidence is not None:
        row["diversity"] = diversity(episodes, items, tag_jaccard(incidence))
    if counts is None or numbers is None:
        return row
    shown, liked = (
        np.bincount(numbers[numbers >= 0], counted.numpy()[numbers >= 0], n_items)
        for counted in (counts.shown, counts.liked)
    )
    if shown.any():
        row["novelty"] = novelty(items, shown / counts.episodes)
    if incidence is not None and liked.any():
        dominant = dominant_tags(incidence, liked.astype(np.int64))
        row["majority_category_dominance"] = dominance(items, incidence, dominant)
    return row


def _incidence(env: VectorEnv[Any, Any, Any]) -> BoolArray | None:
    """Tags (n_items, n_tags) of the environment's catalogue; None if it has no tags."""
    environment = env.unwrapped
    table = environment.item_features() if isinstance(environment, Catalog) else pa.table({})
    hot = [name for name in table.column_names if name.startswith(ONE_HOT)]
    if hot:
        return np.stack([np.asarray(table[name]) > 0 for name in hot], axis=1)
    if TAGS not in table.column_names:
        return None
    column = table[TAGS].combine_chunks()
    known, places = np.unique(np.asarray(column.flatten()), return_inverse=True)
    incidence = np.zeros((len(column), len(known)), dtype=np.bool_)
    incidence[np.repeat(np.arange(len(column)), np.diff(np.asarray(column.offsets))), places] = True
    return incidence
