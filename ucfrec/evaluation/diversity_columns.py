"""Coverage, diversity, novelty and dominance as columns of a result row."""

from typing import Any

import numpy as np
import pyarrow as pa
from gymnasium.vector import VectorEnv

from ucfrec.arrays import BoolArray, IntArray
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.evaluation.collect import Catalog, environment_items
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
"""Catalogue column with the list of each item's tags."""
ONE_HOT = "tag_"
"""Prefix of catalogue columns, one per tag, that are above 0 for items with the tag."""
COLUMNS = (
    "coverage", "coverage_per_turn", "diversity", "novelty", "majority_category_dominance",
)  # fmt: skip


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
