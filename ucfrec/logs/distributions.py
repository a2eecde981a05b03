"""How session lengths, rewards and item popularity are spread: small enough for `meta.json`."""

from typing import Any, Final

import numpy as np

from ucfrec import schema
from ucfrec.logs.clean import CleanLog

QUANTILES: Final = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
FEW_VALUES: Final = 20
"""Rewards with at most this many values are counted by value, others in this many bins."""
SAMPLE_ROWS: Final = 100_000
"""Quantiles of rewards come from about this many steps; those of a smaller log are exact."""

Distribution = dict[str, Any]
"""`counts`, with `values` or else `edges` (one more than counts; a bin has its left edge and not
its right one), and `quantiles` by share, as in `{"0.5": 3}`."""


def distributions(log: CleanLog) -> dict[str, Distribution]:
    """Distributions over the table `steps`, JSON-able.

    Returns:
        `session_lengths`, the episodes by steps (a session cut at a split counts as its pieces),
        in bins that double; `rewards`, the steps by reward, where the first and last bin also take
        what lies beyond them; and, of logs with items, `item_popularity`, the items by the steps
        that show them, never shown ones of the feature tables included, in bins that double.
    """
    user, item = schema.USER_ID, schema.ITEM_ID
    lengths = f"SELECT count(*) AS value FROM steps GROUP BY {user}, episode"
    found = {"session_lengths": _counts(log, lengths), "rewards": _rewards(log)}
    if log.key == item:
        shown = f"SELECT {item}, count(*) AS value FROM steps GROUP BY {item}"
        popularity = (
            f"SELECT coalesce(value, 0) AS value FROM items LEFT JOIN ({shown}) USING ({item})"
        )
        found["item_popularity"] = _counts(log, popularity)
    return found


def _counts(log: CleanLog, query: str) -> Distribution:
    """Of whole numbers `value` ≥ 0, in bins 0, 1, 2–3, 4–7, …"""
    rows = log.connection.sql(
        f"SELECT value, count(*) FROM ({query}) GROUP BY value ORDER BY value"
    ).fetchall()
    values, counts = np.array(rows, dtype=np.int64).T
    edges = [0, *(2**power for power in range(int(values[-1]).bit_length() + 1))]
    edges = edges[1:] if values[0] > 0 else edges
    binned, _ = np.histogram(values, edges, weights=counts)
    below = np.cumsum(counts)
    places = np.searchsorted(below, np.ceil(np.array(QUANTILES) * below[-1]).clip(min=1))
    return {
        "edges": edges,
        "counts": binned.astype(np.int64).tolist(),
        "quantiles": _by_share(values[places].tolist()),
    }


def _rewards(log: CleanLog) -> Distribution:
    (rows,) = log.one("SELECT count(*) FROM steps")
    # By hash, so that the order of rows in the files does not matter.
    every = max(1, round(rows / SAMPLE_ROWS))
    keys = f"hash({schema.USER_ID}, {log.key}, {schema.TIMESTAMP})"
    sample = f"SELECT reward FROM steps WHERE {keys} % {every} = 0"
    quantiles, distinct = log.one(
        f"SELECT quantile_disc(reward, {list(QUANTILES)}), count(DISTINCT reward) FROM ({sample})"
    )
    by_share = {"quantiles": _by_share(quantiles)}
    if distinct <= FEW_VALUES:
        found = log.connection.sql(
            "SELECT reward, count(*) FROM steps GROUP BY reward ORDER BY reward "
            f"LIMIT {FEW_VALUES + 1}"
        ).fetchall()
        if len(found) <= FEW_VALUES:
            values, counts = map(list, zip(*found, strict=True))
            return {"values": values, "counts": counts, **by_share}
    low, high = quantiles[1], quantiles[-2]
    if not low < high:
        low, high = log.one("SELECT min(reward), max(reward) FROM steps")
    width = (high - low) / FEW_VALUES
    place = f"greatest(0, least({FEW_VALUES - 1}, floor((reward - {low}) / {width})))"
    binned = dict(
        log.connection.sql(
            f"SELECT CAST({place} AS INT) AS bin, count(*) FROM steps GROUP BY bin"
        ).fetchall()
    )
    return {
        "edges": np.linspace(low, high, FEW_VALUES + 1).tolist(),
        "counts": [binned.get(place, 0) for place in range(FEW_VALUES)],
        **by_share,
    }


def _by_share(values: list[Any]) -> dict[str, Any]:
    return {f"{share:g}": value for share, value in zip(QUANTILES, values, strict=True)}
