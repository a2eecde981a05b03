"""What a log's episodes hold, counted in one pass over its sorted rows, and its distributions."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final

import duckdb
import numpy as np
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.logs.engine import as_arrow
from ucfrec.logs.kept import mixed
from ucfrec.logs.sessions import Cut, Episodes, read_episodes
from ucfrec.logs.sorted_rows import ITEM, SortedRows
from ucfrec.logs.typed import TypedLog

FEW_VALUES: Final = 20
"""Rewards with at most this many distinct values are counted by value, others in as many bins."""
SAMPLE_ROWS: Final = 100_000
"""Quantiles of rewards of many values are of a sample of about this many steps; a smaller log is
used whole."""
QUANTILES: Final = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
EPISODES: Final = "episodes"
"""Table of the episodes: `episode` (number, from 0), `user_code`, `split`, `steps`,
`begins_session` and `terminated`."""
USED_USERS, USED_ITEMS = "used_users", "used_items"
"""Tables of the users and items in the steps: id, `code` and `train_count`; of users `longest`, the
steps of their longest episode, and `ended`, whether their last one is terminated; of items
`steps`."""

Distribution = dict[str, Any]
"""`counts` (N), either `values` (N) or bin `edges` (N + 1; a bin includes its left edge but not its
right one), and `quantiles` by share, e.g. `{"0.5": 3}`."""


@dataclass
class ValueCounts:
    """How often each number occurred, until there are more than `FEW_VALUES` of them."""

    values: Array = field(default_factory=lambda: np.zeros(0))
    """Ascending."""
    counts: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Of each value."""
    few: bool = True
    """Whether all numbers so far were counted."""

    def add(self, numbers: Array) -> None:
        """Count more numbers."""
        if not self.few:
            return
        places = np.searchsorted(self.values, numbers)
        counted = np.zeros(len(numbers), dtype=bool)
        if len(self.values):
            counted = self.values[np.minimum(places, len(self.values) - 1)] == numbers
        if not counted.all():
            new = np.unique(numbers[~counted])
            self.few = len(self.values) + len(new) <= FEW_VALUES
            if not self.few:
                return
            values = np.union1d(self.values, new)
            counts = np.zeros(len(values), dtype=np.int64)
            counts[np.searchsorted(values, self.values)] = self.counts
            self.values, self.counts = values, counts
            places = np.searchsorted(values, numbers)
        self.counts += np.bincount(places, minlength=len(self.values))


class Moments:
    """Number, mean and sums of squared deviations of vectors of one size.

    Batches are merged by the formula of Chan, Golub and LeVeque (1983), whose rounding errors do
    not grow with the mean.
    """

    def __init__(self, size: int) -> None:
        """
        Args:
            size: of a vector.
        """
        self.count = 0
        self.mean = np.zeros(size)
        self._deviations = np.zeros((size, size))

    def add(self, *values: Array) -> None:
        """Add M vectors.

        Args:
            values: (M,) numbers of each of their entries.
        """
        batch = np.array(values, dtype=np.float64)
        if not batch.shape[1]:
            return
        mean = batch.mean(axis=1)
        centred = batch - mean[:, None]
        apart = mean - self.mean
        total = self.count + batch.shape[1]
        self._deviations += centred @ centred.T
        self._deviations += np.outer(apart, apart) * (self.count * batch.shape[1] / total)
        self.mean += apart * (batch.shape[1] / total)
        self.count = total

    @property
    def covariance(self) -> Float64Array:
        """(size, size) covariance of all vectors so far, not corrected for their number."""
        return self._deviations / max(self.count, 1)


@dataclass
class StepCounts:
    """Counts and statistics of the steps in episodes."""

    item_steps: IntArray
    """(items,) number of steps that show each item, by code."""
    item_train_steps: IntArray
    """(items,) number of those in the training split."""
    steps: int = 0
    first_ms: int = np.iinfo(np.int64).max
    last_ms: int = 0
    rewards: Moments = field(default_factory=lambda: Moments(1))
    values: ValueCounts = field(default_factory=ValueCounts)
    lowest: float = np.inf
    highest: float = -np.inf
    returns: Moments = field(default_factory=lambda: Moments(2))
    """Of training steps: rewards and number of steps from there to the end of the episode."""
    long_rows: int = 0
    """Rows of episodes that are dropped as too long."""
    unknown_propensities: int = 0
    not_above_0: int = 0
    """Propensities of 0 or less."""
    lowest_propensity: float = 0.0
    above_1: int = 0
    """Propensities above 1."""
    highest_propensity: float = 0.0

    def add(self, episodes: Episodes) -> None:
        """Count the steps of episodes."""
        self.long_rows += episodes.long_rows
        times, rewards = (episodes.rows[name] for name in (schema.TIMESTAMP, schema.REWARD))
        if not len(times):
            return
        self.steps += len(times)
        self.first_ms = min(self.first_ms, int(times.min()))
        self.last_ms = max(self.last_ms, int(times.max()))
        self.rewards.add(rewards)
        self.values.add(rewards)
        self.lowest = min(self.lowest, float(rewards.min()))
        self.highest = max(self.highest, float(rewards.max()))
        training = np.repeat(episodes.splits == 0, episodes.lengths)
        ends = np.cumsum(episodes.lengths)
        ahead = np.repeat(ends, episodes.lengths) - np.arange(len(rewards))
        earned = np.append(0.0, np.cumsum(rewards))
        return_to_go = np.repeat(earned[ends], episodes.lengths) - earned[:-1]
        self.returns.add(return_to_go[training], ahead[training])
        if ITEM in episodes.rows:
            items, size = episodes.rows[ITEM], len(self.item_steps)
            self.item_steps += np.bincount(items, minlength=size)
            self.item_train_steps += np.bincount(items[training], minlength=size)
        if schema.PROPENSITY in episodes.rows:
            propensities = episodes.rows[schema.PROPENSITY]
            self.unknown_propensities += int(np.count_nonzero(np.isnan(propensities)))
            self.not_above_0 += int(np.count_nonzero(propensities <= 0))
            self.above_1 += int(np.count_nonzero(propensities > 1))
            lowest, highest = np.fmin.reduce(propensities), np.fmax.reduce(propensities)
            self.lowest_propensity = float(np.fmin(self.lowest_propensity, lowest))
            self.highest_propensity = float(np.fmax(self.highest_propensity, highest))


def count_steps(rows: SortedRows, cut: Cut) -> StepCounts:
    """Go through all episodes once, and create `EPISODES`, `USED_USERS` and `USED_ITEMS`.

    Only training steps count in `train_count`.

    Raises:
        InputError: no episode is left, none is in the training split, or a propensity is none.
    """
    connection = rows.log.connection
    items = rows.log.one("SELECT count(*) FROM item_codes")[0] if _has_items(rows) else 0
    counts = StepCounts(np.zeros(items, dtype=np.int64), np.zeros(items, dtype=np.int64))
    names = ("user_code", "split", "steps", "begins_session", "terminated")
    whole_numbers = pa.schema([(name, pa.int64()) for name in names])

    def count() -> Iterator[pa.RecordBatch]:
        for episodes in read_episodes(rows, cut):
            counts.add(episodes)
            columns = [episodes.users, episodes.splits, episodes.lengths]
            flags = [episodes.begins_session, episodes.terminated]
            columns += [values.astype(np.int64) for values in flags]
            yield pa.record_batch([as_arrow(values) for values in columns], schema=whole_numbers)

    connection.register("counted", pa.RecordBatchReader.from_batches(whole_numbers, count()))
    connection.execute(
        f"CREATE TABLE {EPISODES} AS SELECT row_number() OVER () - 1 AS episode, user_code, split, "
        "steps, begins_session = 1 AS begins_session, terminated = 1 AS terminated FROM counted"
    )
    connection.execute(
        f"""
        CREATE TABLE {USED_USERS} AS
        SELECT {schema.USER_ID}, code, train_count, longest, ended FROM user_codes JOIN (
            SELECT user_code AS code, max(steps) AS longest, arg_max(terminated, episode) AS ended,
                CAST(coalesce(sum(steps) FILTER (split = 0), 0) AS BIGINT) AS train_count
            FROM {EPISODES} GROUP BY user_code
        ) USING (code)
        """
    )
    if _has_items(rows):
        codes = np.flatnonzero(counts.item_steps)
        columns = (codes, counts.item_steps[codes], counts.item_train_steps[codes])
        connection.register(
            "shown",
            pa.record_batch(
                [as_arrow(column) for column in columns], ["code", "steps", "train_count"]
            ),
        )
        connection.execute(
            f"CREATE TABLE {USED_ITEMS} AS SELECT {schema.ITEM_ID}, code, steps, train_count "
            "FROM item_codes JOIN shown USING (code)"
        )
    _require_training(rows, cut, counts.steps)
    if schema.PROPENSITY in rows.log.columns:
        _require_propensities(rows.log, counts)
    return counts


def _has_items(rows: SortedRows) -> bool:
    return rows.log.key == schema.ITEM_ID


def report_steps(rows: SortedRows, counts: StepCounts) -> dict[str, Any]:
    """Counts and statistics of the episodes, for the report."""
    log = rows.log
    splits = {name: {"episodes": 0, "steps": 0} for name in schema.SPLITS}
    for split, episodes, steps in log.connection.sql(
        f"SELECT split, count(*), CAST(sum(steps) AS BIGINT) FROM {EPISODES} GROUP BY split"
    ).fetchall():
        splits[schema.SPLITS[split]] = {"episodes": episodes, "steps": steps}
    sessions, unfinished = log.one(
        f"SELECT count(*) FILTER (begins_session), count(*) FILTER (NOT terminated) FROM {EPISODES}"
    )
    users, censored = log.one(f"SELECT count(*), count(*) FILTER (NOT ended) FROM {USED_USERS}")
    report: dict[str, Any] = {
        "steps": counts.steps,
        "episodes": sum(split["episodes"] for split in splits.values()),
        "sessions": sessions,
        "sessions_cut": unfinished - censored,
        "sessions_censored": censored,
        "return_length_share": _explain_returns(counts.returns),
        "users": users,
        "splits": splits,
        "time_range_ms": [counts.first_ms, counts.last_ms],
        "reward_statistics": {
            "mean": float(counts.rewards.mean[0]),
            "std": float(np.sqrt(counts.rewards.covariance[0, 0])),
            "min": counts.lowest,
            "max": counts.highest,
        },
    }
    if _has_items(rows):
        report["items"] = int(np.count_nonzero(counts.item_steps))
    if schema.PROPENSITY in log.columns:
        report["unknown_propensities"] = counts.unknown_propensities
    return report


def _explain_returns(returns: Moments) -> float | None:
    """Share of the variance of training returns-to-go that the number of steps left explains.

    Of the whole rest of the session; None if either does not vary.
    """
    (return_to_go, both), (_, ahead) = returns.covariance
    # What is left of the rounding errors of equal returns is not variance.
    if return_to_go <= 1e-24 * returns.mean[0] ** 2 or not ahead:
        return None
    return float(both**2 / (return_to_go * ahead))


def _require_training(rows: SortedRows, cut: Cut, steps: int) -> None:
    if not steps:
        raise InputError(
            f"no session is left: none of the {rows.count} clean rows is in an episode of "
            f"{cut.min_steps} steps or more; lower min_steps or widen the sessions"
        )
    if not rows.log.one(f"SELECT count(*) FROM {EPISODES} WHERE split = 0")[0]:
        ends = datetime.fromtimestamp(cut.bounds[0] / 1000, UTC)
        raise InputError(
            f"no row is in the training split, before {ends:%Y-%m-%d %H:%M:%S} UTC: all are of "
            "that time or later; log finer times, or choose a later split"
        )


def _require_propensities(log: TypedLog, counts: StepCounts) -> None:
    name = schema.PROPENSITY
    if counts.not_above_0:
        lowest = f"{counts.lowest_propensity:.6g}"
        raise InputError(
            f"{log.name}: {name} is not above 0, down to {lowest}, in {counts.not_above_0:,} of "
            f"{counts.steps:,} rows; of a logarithm give --column propensity='exp(propensity)'; "
            f"if {lowest} means unknown, --column propensity='nullif(propensity, {lowest})'"
        )
    if counts.above_1 and log.key == schema.ITEM_ID:
        raise InputError(
            f"{log.name}: {name} is above 1, up to {counts.highest_propensity:.6g}, in "
            f"{counts.above_1:,} of {counts.steps:,} rows; give the probability that the item was "
            "shown: of a percentage with --column propensity='propensity / 100', or ignore the "
            "column with --column propensity="
        )


def measure_distributions(
    rows: SortedRows, cut: Cut, counts: StepCounts
) -> dict[str, Distribution]:
    """Distributions over the steps, as JSON values; after the tables of users and items.

    Returns:
        `session_lengths`: episodes by length in steps (each piece of a session that a split cuts
        counts as one), in bins of doubling width. `rewards`: steps by reward; the first and last
        bin include the values beyond them. `item_popularity` (logs with items only): items by the
        number of steps that show them, in bins of doubling width; items that only the feature
        tables list have 0.
    """
    connection, values = rows.log.connection, counts.values
    lengths = _count_values(connection, f"SELECT steps FROM {EPISODES}")
    result = {"session_lengths": _bin(*lengths)}
    if values.few:
        result["rewards"] = {
            "values": values.values.tolist(),
            "counts": values.counts.tolist(),
            "quantiles": _weigh_quantiles(values.values, values.counts),
        }
    else:
        result["rewards"] = _bin_rewards(rows, cut, counts)
    if _has_items(rows):
        shown = f"SELECT coalesce(steps, 0) FROM items LEFT JOIN {USED_ITEMS} USING (item_id)"
        result["item_popularity"] = _bin(*_count_values(connection, shown))
    return result


def _count_values(connection: duckdb.DuckDBPyConnection, query: str) -> tuple[Array, IntArray]:
    """Distinct values of a query of one column, ascending, and how often each occurs."""
    rows = connection.sql(
        f"SELECT value, count(*) FROM ({query}) AS of_query(value) GROUP BY value ORDER BY value"
    ).fetchall()
    return np.array([value for value, _ in rows]), np.array([count for _, count in rows])


def _bin(values: IntArray, counts: IntArray) -> Distribution:
    """Distribution of distinct integers ≥ 0, ascending, in bins 0, 1, 2–3, 4–7, …"""
    edges = [0, *(2**power for power in range(int(values[-1]).bit_length() + 1))]
    edges = edges[1:] if values[0] > 0 else edges
    binned, _ = np.histogram(values, edges, weights=counts)
    return {
        "edges": edges,
        "counts": binned.astype(np.int64).tolist(),
        "quantiles": _weigh_quantiles(values, counts),
    }


def _bin_rewards(rows: SortedRows, cut: Cut, counts: StepCounts) -> Distribution:
    """Distribution of rewards of many values."""
    every, sample = max(1, round(counts.steps / SAMPLE_ROWS)), []
    for episodes in read_episodes(rows, cut):
        rewards, times = (episodes.rows[name] for name in (schema.REWARD, schema.TIMESTAMP))
        # By hash, so that the order of rows in the files does not matter.
        keys = np.repeat(episodes.users, episodes.lengths).astype(np.uint64) << np.uint64(41)
        sample.append(rewards[mixed(keys + times.astype(np.uint64)) % np.uint64(every) == 0])
    ordered = np.sort(np.concatenate(sample))
    quantiles = _weigh_quantiles(ordered, np.ones(len(ordered), dtype=np.int64))
    ends = list(quantiles.values())
    low, high = ends[1], ends[-2]
    if not low < high:
        low, high = counts.lowest, counts.highest
    edges = np.linspace(low, high, FEW_VALUES + 1)
    within = np.array([-np.inf, *edges[1:-1], np.inf])
    filled = sum(np.histogram(e.rows[schema.REWARD], within)[0] for e in read_episodes(rows, cut))
    return {
        "edges": edges.tolist(),
        "counts": np.asarray(filled).tolist(),
        "quantiles": quantiles,
    }


def _weigh_quantiles(values: Array, counts: IntArray) -> dict[str, Any]:
    """Quantiles, each one of the ascending values, of which there are `counts`."""
    cumulative = np.cumsum(counts)
    ranks = np.ceil(np.array(QUANTILES) * cumulative[-1]).clip(min=1)
    chosen = values[np.searchsorted(cumulative, ranks)].tolist()
    return {f"{share:g}": value for share, value in zip(QUANTILES, chosen, strict=True)}
