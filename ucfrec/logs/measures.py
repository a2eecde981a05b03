"""What a log's episodes hold, counted in one pass over its sorted rows."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError
from ucfrec.logs.moments import Moments
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
        cut: how they form episodes.
        log_end: time (ms) of the log's last usable row.
        items: number of items that have a code.
        folder: of the spool of users.

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
        raise InputError(
            f"no row is in the training split (before {cut.bounds[0]} ms); choose a later split"
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
        unknown = np.isnan(found.column(spool, schema.PROPENSITY))
        measures.unknown_propensities += int(np.count_nonzero(unknown))


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
    mixed = users.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + times.astype(np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return mixed ^ (mixed >> np.uint64(31))


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
