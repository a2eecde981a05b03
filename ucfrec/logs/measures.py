"""What a log's episodes hold, counted in one pass over its sorted rows, and its distributions."""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec.logs.kept import mixed
from ucfrec.logs.sessions import Cut, Episodes, episodes
from ucfrec.logs.spool import BLOCK, Spool

FEW_VALUES: Final = 20
"""Rewards with at most this many distinct values are counted by value, others in as many bins."""
_NAMED: Final = 5
"""Users of the longest sessions that are named."""
SAMPLE_ROWS: Final = 100_000
"""Quantiles of rewards of many values are of a sample of about this many steps; a smaller log is
used whole."""


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
        known = np.zeros(len(numbers), dtype=bool)
        if len(self.values):
            known = self.values[np.minimum(places, len(self.values) - 1)] == numbers
        if not known.all():
            new = np.unique(numbers[~known])
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
class Measures:
    """Counts and statistics of the steps in episodes that are kept."""

    users: Spool
    """Users in order: `user`, and `train_count`, the number of their training steps."""
    item_steps: IntArray
    """(items,) number of steps that show each item, by code."""
    item_train_steps: IntArray
    """(items,) number of those in the training split."""
    steps: int = 0
    episodes: int = 0
    sessions: int = 0
    unfinished: int = 0
    """Episodes that are not terminated."""
    censored: int = 0
    """Users whose last episode is not terminated."""
    first_ms: int = 0
    last_ms: int = 0
    unknown_propensities: int = 0
    not_above_0: int = 0
    """Propensities of 0 or less."""
    lowest_propensity: float = 0.0
    above_1: int = 0
    """Propensities of items above 1."""
    highest_propensity: float = 0.0
    splits: IntArray = field(default_factory=lambda: np.zeros((3, 2), dtype=np.int64))
    """Episodes and steps of each split."""
    rewards: Moments = field(default_factory=lambda: Moments(1))
    lowest: float = np.inf
    highest: float = -np.inf
    returns: Moments = field(default_factory=lambda: Moments(2))
    """Of training steps: rewards and number of steps from there to the end of the episode."""
    lengths: dict[int, int] = field(default_factory=dict)
    """Length in steps to the number of episodes."""
    longest: list[tuple[int, int]] = field(default_factory=list)
    """Steps of the longest episode of the users who have the longest, and these users."""
    long_rows: int = 0
    """Rows of episodes that are dropped as too long."""
    values: ValueCounts = field(default_factory=ValueCounts)
    """Rewards by value."""


def measure(spool: Spool, cut: Cut, log_end: int, items: int, folder: Path) -> Measures:
    """Go through all episodes once.

    Args:
        spool: rows in the order of the store, at least one.
        log_end: time (ms) of the log's last usable row.
        items: number of items that have a code.

    Raises:
        InputError: no episode remains, or none in the training split.
    """
    measures = Measures(
        Spool(folder), np.zeros(items, dtype=np.int64), np.zeros(items, dtype=np.int64)
    )
    user, trained, ended = None, 0, True
    for found in episodes(spool, cut, log_end):
        measures.long_rows += found.long_rows
        if not len(found.lengths):
            continue
        _count_episodes(measures, found)
        _count_steps(measures, found, spool)
        starts = np.flatnonzero(np.append(True, found.users[1:] != found.users[:-1]))
        users = found.users[starts]
        training = np.where(found.splits == 0, found.lengths, 0)
        train_counts = np.add.reduceat(training, starts)
        last = np.append(starts[1:], len(found.users)) - 1
        ends = found.terminated[last]
        if user is not None and users[0] == user:
            train_counts[0] += trained
        elif user is not None:
            measures.users.append({"user": np.array([user]), "train_count": np.array([trained])})
            measures.censored += not ended
        measures.users.append({"user": users[:-1], "train_count": train_counts[:-1]})
        measures.censored += int(np.count_nonzero(~ends[:-1]))
        user, trained, ended = users[-1], train_counts[-1], bool(ends[-1])
    if user is not None:
        measures.users.append({"user": np.array([user]), "train_count": np.array([trained])})
        measures.censored += not ended
    _require_training(measures, cut, len(spool))
    return measures


def _require_training(measures: Measures, cut: Cut, rows: int) -> None:
    if measures.steps == 0:
        raise InputError(
            f"no session is left: none of the {rows} clean rows is in an episode of "
            f"{cut.min_steps} steps or more; lower min_steps or widen the sessions"
        )
    if measures.splits[0, 1] == 0:
        ends = datetime.fromtimestamp(cut.bounds[0] / 1000, UTC)
        raise InputError(
            f"no row is in the training split, before {ends:%Y-%m-%d %H:%M:%S} UTC: all are of "
            "that time or later; log finer times, or choose a later split"
        )


def _count_episodes(measures: Measures, found: Episodes) -> None:
    measures.steps += int(found.lengths.sum())
    measures.episodes += len(found.lengths)
    measures.sessions += int(np.count_nonzero(found.begins_session))
    measures.unfinished += int(np.count_nonzero(~found.terminated))
    measures.splits[:, 0] += np.bincount(found.splits, minlength=3)
    weighted = np.bincount(found.splits, weights=found.lengths, minlength=3)
    measures.splits[:, 1] += weighted.astype(np.int64)
    for length, count in zip(*np.unique(found.lengths, return_counts=True), strict=True):
        measures.lengths[int(length)] = measures.lengths.get(int(length), 0) + int(count)
    longest = {user: length for length, user in measures.longest}
    for number in np.argsort(-found.lengths, kind="stable")[: 10 * _NAMED]:
        user, length = int(found.users[number]), int(found.lengths[number])
        longest[user] = max(length, longest.get(user, 0))
    pairs = ((length, user) for user, length in longest.items())
    measures.longest = sorted(pairs, reverse=True)[:_NAMED]


def _count_steps(measures: Measures, found: Episodes, spool: Spool) -> None:
    times = found.column(spool, schema.TIMESTAMP)
    rewards = found.column(spool, schema.REWARD)
    low, high = int(times.min()), int(times.max())
    first = measures.steps == int(found.lengths.sum())
    measures.first_ms = low if first else min(measures.first_ms, low)
    measures.last_ms = max(measures.last_ms, high)
    measures.rewards.add(rewards)
    measures.lowest = min(measures.lowest, float(rewards.min()))
    measures.highest = max(measures.highest, float(rewards.max()))
    measures.values.add(rewards)
    training = np.repeat(found.splits == 0, found.lengths)
    ends = np.cumsum(found.lengths)
    ahead = np.repeat(ends, found.lengths) - np.arange(len(rewards))
    before = np.concatenate([[0.0], np.cumsum(rewards)])
    rest = np.repeat(before[ends], found.lengths) - before[:-1]
    measures.returns.add(rest[training], ahead[training])
    if schema.ITEM in spool.names:
        choice = found.column(spool, schema.ITEM)
        items = len(measures.item_steps)
        measures.item_steps += np.bincount(choice, minlength=items)
        measures.item_train_steps += np.bincount(choice[training], minlength=items)
    if schema.PROPENSITY in spool.names:
        propensities = found.column(spool, schema.PROPENSITY)
        measures.unknown_propensities += int(np.count_nonzero(np.isnan(propensities)))
        if (below := propensities <= 0).any():
            measures.not_above_0 += int(np.count_nonzero(below))
            lowest = float(propensities[below].min())
            measures.lowest_propensity = min(measures.lowest_propensity, lowest)
        if schema.ITEM in spool.names and (above := propensities > 1).any():
            measures.above_1 += int(np.count_nonzero(above))
            highest = float(propensities[above].max())
            measures.highest_propensity = max(measures.highest_propensity, highest)


def sampled_rewards(spool: Spool, cut: Cut, log_end: int, steps: int) -> Array:
    """Rewards of about `SAMPLE_ROWS` of the `steps` steps, ascending; of all if there are fewer."""
    every = max(1, round(steps / SAMPLE_ROWS))
    sample = []
    for found in episodes(spool, cut, log_end, BLOCK):
        rewards = found.column(spool, schema.REWARD)
        if every > 1:
            # By hash, so that the order of rows in the files does not matter.
            users = np.repeat(found.users, found.lengths)
            keys = _hash(users, found.column(spool, schema.TIMESTAMP))
            rewards = rewards[keys % np.uint64(every) == 0]
        sample.append(rewards)
    return np.sort(np.concatenate(sample))


def _hash(users: Array, times: Array) -> npt.NDArray[np.uint64]:
    """A number for each row that depends on its user and time: the finaliser of SplitMix64."""
    own = (users.astype(np.uint64) - np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    return mixed(own + times.astype(np.uint64))


def binned_rewards(
    spool: Spool, cut: Cut, log_end: int, low: float, high: float, bins: int
) -> IntArray:
    """Steps by reward in `bins` bins of equal width from `low` to `high`.

    The first and the last bin include the values beyond them.
    """
    counts = np.zeros(bins, dtype=np.int64)
    width = (high - low) / bins
    for found in episodes(spool, cut, log_end, BLOCK):
        rewards = found.column(spool, schema.REWARD)
        places = np.clip(np.floor((rewards - low) / width), 0, bins - 1).astype(np.int64)
        counts += np.bincount(places, minlength=bins)
    return counts


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
