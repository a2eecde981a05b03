"""Distributions of session lengths, rewards and item popularity, compact enough for `meta.json`."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ucfrec.logs.measures import FEW_VALUES, Measures

QUANTILES: Final = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)

Distribution = dict[str, Any]
"""`counts` (N), either `values` (N) or bin `edges` (N + 1; a bin includes its left edge but not its
right one), and `quantiles` by share, e.g. `{"0.5": 3}`."""
IntArray = npt.NDArray[np.int64]
Binned = Callable[[float, float, int], IntArray]
"""Counts the steps by reward in bins of equal width; see `ucfrec.logs.measures.binned_rewards`."""


def distributions(
    measures: Measures, popularity: IntArray | None, binned: Binned
) -> dict[str, Distribution]:
    """Distributions over the steps, as JSON values.

    Args:
        measures: of the log.
        popularity: (items,) number of steps that show each item; None for logs without items.
        binned: counts rewards in bins, if there are many.

    Returns:
        `session_lengths`: episodes by length in steps (each piece of a session that a split cuts
        counts as one), in bins of doubling width. `rewards`: steps by reward; the first and last
        bin include the values beyond them. `item_popularity` (logs with items only): items by the
        number of steps that show them, in bins of doubling width; items that only the feature
        tables list have 0.
    """
    lengths = np.array(sorted(measures.lengths.items()), dtype=np.int64).T
    result = {"session_lengths": _counts(*lengths), "rewards": _rewards(measures, binned)}
    if popularity is not None:
        result["item_popularity"] = _counts(*np.unique(popularity, return_counts=True))
    return result


def _counts(values: IntArray, counts: IntArray) -> Distribution:
    """Distribution of distinct integers ≥ 0, ascending, in bins 0, 1, 2–3, 4–7, …"""
    edges = [0, *(2**power for power in range(int(values[-1]).bit_length() + 1))]
    edges = edges[1:] if values[0] > 0 else edges
    binned, _ = np.histogram(values, edges, weights=counts)
    cumulative = np.cumsum(counts)
    ranks = np.ceil(np.array(QUANTILES) * cumulative[-1]).clip(min=1)
    positions = np.searchsorted(cumulative, ranks)
    return {
        "edges": edges,
        "counts": binned.astype(np.int64).tolist(),
        "quantiles": _by_share(values[positions].tolist()),
    }


def _rewards(measures: Measures, binned: Binned) -> Distribution:
    sample = np.sort(np.concatenate(measures.sample))
    ranks = np.ceil(np.array(QUANTILES) * len(sample)).astype(np.int64).clip(min=1)
    quantiles = sample[ranks - 1].tolist() if len(sample) else [measures.lowest] * len(QUANTILES)
    by_share = {"quantiles": _by_share(quantiles)}
    counted = measures.values
    if counted.few:
        return {"values": counted.values.tolist(), "counts": counted.counts.tolist(), **by_share}
    low, high = quantiles[1], quantiles[-2]
    if not low < high:
        low, high = measures.lowest, measures.highest
    return {
        "edges": np.linspace(low, high, FEW_VALUES + 1).tolist(),
        "counts": binned(low, high, FEW_VALUES).tolist(),
        **by_share,
    }


def _by_share(values: list[Any]) -> dict[str, Any]:
    return {f"{share:g}": value for share, value in zip(QUANTILES, values, strict=True)}
