"""Distributions of session lengths, rewards and item popularity, compact enough for `meta.json`."""

from typing import Any, Final

import numpy as np

from ucfrec import schema
from ucfrec.logs.clean import CleanLog

QUANTILES: Final = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
FEW_VALUES: Final = 20
"""Rewards with at most this many distinct values are counted by value, others in as many bins."""
SAMPLE_ROWS: Final = 100_000
"""Reward quantiles are of a sample of about this many steps; a smaller log is used whole."""

Distribution = dict[str, Any]
"""`counts` (N), either `values` (N) or bin `edges` (N + 1; a bin includes its left edge but not its
right one), and `quantiles` by share, e.g. `{"0.5": 3}`."""


def distributions(log: CleanLog) -> dict[str, Distribution]:
    """Distributions over the table `steps`, as JSON values.

    Returns:
        `session_lengths`: episodes by length in steps (each piece of a session that a split cuts
        counts as one), in bins of doubling width. `rewards`: steps by reward; the first and last
        bin include the values beyond them. `item_popularity` (logs with items only): items by the
        number of steps that show them, in bins of doubling width; items that only the feature
        tables list have 0.
    """
    user, item = schema.USER_ID, schema.ITEM_ID
    lengths = f"SELECT count(*) AS value FROM steps GROUP BY {user}, episode"
    result = {"session_lengths": _counts(log, lengths), "rewards": _rewards(log)}
    if log.key == item:
        shown = f"SELECT {item}, count(*) AS value FROM steps GROUP BY {item}"
        popularity = (
            f"SELECT coalesce(value, 0) AS value FROM items LEFT JOIN ({shown}) USING ({item})"
        )
        result["item_popularity"] = _counts(log, popularity)
    return result


def _counts(log: CleanLog, query: str) -> Distribution:
    """Distribution of the integers `value` ≥ 0 of `query`, in bins 0, 1, 2–3, 4–7, …"""
    rows = log.connection.sql(
        f"SELECT value, count(*) FROM ({query}) GROUP BY value ORDER BY value"
    ).fetchall()
    values, counts = np.array(rows, dtype=np.int64).T
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


def _rewards(log: CleanLog) -> Distribution:
    (rows,) = log.one("SELECT count(*) FROM steps")
    # Sampled by hash, so that the order of rows in the files does not matter.
    every = max(1, round(rows / SAMPLE_ROWS))
    keys = f"hash({schema.USER_ID}, {log.key}, {schema.TIMESTAMP})"
    sample = f"SELECT reward FROM steps WHERE {keys} % {every} = 0"
    quantiles, distinct = log.one(
        f"SELECT quantile_disc(reward, {list(QUANTILES)}), count(DISTINCT reward) FROM ({sample})"
    )
    by_share = {"quantiles": _by_share(quantiles)}
    if distinct <= FEW_VALUES:
        counted = log.connection.sql(
            "SELECT reward, count(*) FROM steps GROUP BY reward ORDER BY reward "
            f"LIMIT {FEW_VALUES + 1}"
        ).fetchall()
        if len(counted) <= FEW_VALUES:
            values, counts = map(list, zip(*counted, strict=True))
            return {"values": values, "counts": counts, **by_share}
    low, high = quantiles[1], quantiles[-2]
    if not low < high:
        low, high = log.one("SELECT min(reward), max(reward) FROM steps")
    width = (high - low) / FEW_VALUES
    bin_number = f"greatest(0, least({FEW_VALUES - 1}, floor((reward - {low}) / {width})))"
    binned = dict(
        log.connection.sql(
            f"SELECT CAST({bin_number} AS INT) AS bin, count(*) FROM steps GROUP BY bin"
        ).fetchall()
    )
    return {
        "edges": np.linspace(low, high, FEW_VALUES + 1).tolist(),
        "counts": [binned.get(number, 0) for number in range(FEW_VALUES)],
        **by_share,
    }


def _by_share(values: list[Any]) -> dict[str, Any]:
    return {f"{share:g}": value for share, value in zip(QUANTILES, values, strict=True)}
