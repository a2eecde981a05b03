"""The variety of what was played in a world of items, as columns of a result row."""

from typing import Any

import numpy as np
import pyarrow as pa
from gymnasium.vector import VectorEnv

from ucfrec.acting.rollout import BoolArray, IntArray
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.evaluation.collect import Catalog, world_items
from ucfrec.evaluation.diversity import (
    Recommended,
    coverage,
    coverage_per_turn,
    diversity,
    dominance,
    dominant_tags,
    novelty,
    tag_jaccard,
)

TAGS = "tags"
"""Column of a catalogue that lists each item's tags."""
ONE_HOT = "tag_"
"""Prefix of the columns of a catalogue that has one for each tag instead, above 0 if it holds."""
COLUMNS = (
    "coverage", "coverage_per_turn", "diversity", "novelty", "majority_category_dominance",
)  # fmt: skip


def variety_columns(
    env: VectorEnv[Any, Any, Any],
    recommended: Recommended,
    counts: TrainingCounts | None = None,
    numbers: IntArray | None = None,
) -> dict[str, float | None]:
    """The `COLUMNS`; None where what a metric needs is unknown.

    Diversity (tag Jaccard) and dominance need a catalogue with `tags`; novelty and dominance need
    `counts`, which built-in policies do not have.

    Args:
        counts: of the training log.
        numbers: (items of the log,) the world's number of each, −1 where it has none.
    """
    episodes, items = recommended.sessions()
    n_items = len(world_items(env))
    row: dict[str, float | None] = dict.fromkeys(COLUMNS)
    row["coverage"] = coverage(items, n_items)
    row["coverage_per_turn"] = coverage_per_turn(items)
    incidence = _incidence(env)
    if incidence is not None:
        row["diversity"] = diversity(episodes, items, tag_jaccard(incidence))
    if counts is None or numbers is None:
        return row
    shown, liked = (
        np.bincount(numbers[numbers >= 0], each.numpy()[numbers >= 0], n_items)
        for each in (counts.shown, counts.liked)
    )
    if shown.any():
        row["novelty"] = novelty(items, shown / counts.episodes)
    if incidence is not None and liked.any():
        dominant = dominant_tags(incidence, liked.astype(np.int64))
        row["majority_category_dominance"] = dominance(items, incidence, dominant)
    return row


def _incidence(env: VectorEnv[Any, Any, Any]) -> BoolArray | None:
    """(n_items, n_tags) of the world's catalogue; None where it has no lists of tags."""
    world = env.unwrapped
    table = world.item_features() if isinstance(world, Catalog) else pa.table({})
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
