"""Distributions of session lengths, rewards and item popularity, compact enough for `meta.json`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ucfrec.arrays import Array, IntArray
from ucfrec.logs.measures import FEW_VALUES, Measures

QUANTILES: Final = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)

Distribution = dict[str, Any]
"""`counts` (N), either `values` (N) or bin `edges` (N + 1; a bin includes its left edge but not its
right one), and `quantiles` by share, e.g. `{"0.5": 3}`."""


@dataclass(frozen=True)
class RewardPasses:
    """Passes over the steps that only rewards of many values need."""

    sampled: Callable[[], Array]
    """See `ucfrec.logs.measures.sampled_rewards`."""
    binned: Callable[[float, float, int], IntArray]
    """See `ucfrec.logs.measures.binned_rewards`."""


def distributions(
    measures: Measures, popularity: IntArray | None, passes: RewardPasses
) -> dict[str, Distribution]:
    """Distributions over the steps, as JSON values.

    Args:
        measures: of the log.
        popularity: (items,) number of steps that show each item; None for logs without items.
        passes: over the log's rewards.

    Returns:
        `session_lengths`: episodes by length in steps (each piece of a session that a split cuts
        counts as one), in bins of doubling width. `rewards`: steps by reward; the first and last
        bin include the values beyond them. `item_popularity` (logs with items only): items by the
        number of steps that show them, in bins of doubling width; items that only the feature
        tables list have 0.
    """
    lengths = np.array(sorted(measures.lengths.items()), dtype=np.int64).T
    result = {"session_lengths": _counts(*lengths), "rewards": _rewards(measures, passes)}
    if popularity is not None:
        result["item_popularity"] = _counts(*np.unique(popularity, return_counts=True))
    return result


def _counts(values: IntArray, counts: IntArray) -> Distribution:
    """Distribution of distinct integers ≥ 0, ascending, in bins 0, 1, 2–3, 4–7, …"""
    edges = [0, *(2**power for power in range(int(values[-1]).bit_length() + 1))]
    edges = edges[1:] if values[0] > 0 else edges
    binned, _ = np.histogram(values, edges, weights=counts)
    return {
        "edges": edges,
        "counts": binned.astype(np.int64).tolist(),
        "quantiles": _quantiles(values, counts),
    }


def _rewards(measures: Measures, passes: RewardPasses) -> Distribution:
    counted = measures.values
    if counted.few:
        return {
            "values": counted.values.tolist(),
            "counts": counted.counts.tolist(),
            "quantiles": _quantiles(counted.values, counted.counts),
        }
    sample = passes.sampled()
    quantiles = _quantiles(sample, np.ones(len(sample), dtype=np.int64))
    ends = list(quantiles.values())
    low, high = ends[1], ends[-2]
    if not low < high:
        low, high = measures.lowest, measures.highest
    return {
        "edges": np.linspace(low, high, FEW_VALUES + 1).tolist(),
        "counts": passes.binned(low, high, FEW_VALUES).tolist(),
        "quantiles": quantiles,
    }


def _quantiles(values: Array, counts: IntArray) -> dict[str, Any]:
    """Quantiles, each one of the ascending values, of which there are `counts`."""
    cumulative = np.cumsum(counts)
    ranks = np.ceil(np.array(QUANTILES) * cumulative[-1]).clip(min=1)
    found = values[np.searchsorted(cumulative, ranks)].tolist()
    return {f"{share:g}": value for share, value in zip(QUANTILES, found, strict=True)}
