"""Which later steps count as liked: by the run's range of rewards, or by an expression."""

from pathlib import Path
from typing import Final, Protocol

import numpy as np
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray
from ucfrec.episodes.states import LIKED, ItemStates, least_liked, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.logs.binding import bind, explained
from ucfrec.logs.engine import engine_in_memory
from ucfrec.logs.expressions import Expression
from ucfrec.logs.histories import FrameTable

_ROWS: Final = "steps"


class Liked(Protocol):
    """Says by their rewards whether steps were liked; `str` of it states by what."""

    def __call__(self, store: EpisodeStore, rewards: Array) -> BoolArray:
        """(N,) of N steps of `store`, given their rewards (N,)."""


class LikedByRange:
    """A step is liked if its reward lies at least `LIKED` of the way up the training rewards."""

    def __init__(self, states: ItemStates) -> None:
        self._low, self._high = float(states.reward_low), float(states.reward_high)

    def __call__(self, store: EpisodeStore, rewards: Array) -> BoolArray:
        """(N,) of N steps of `store`, given their rewards (N,)."""
        return liked_rewards(store, rewards)

    def __str__(self) -> str:
        least = least_liked(self._low, self._high)
        return (
            f"reward >= {least:.4g} ({LIKED:.0%} of the way from {self._low:.4g}, the lowest "
            f"training reward, to {self._high:.4g}, the highest or two standard deviations above "
            "the mean, if that is less)"
        )


class LikedExpression:
    """A step is liked if a SQL expression over its `reward` is true; missing values are not."""

    def __init__(self, expression: Expression, reward: str = schema.REWARD) -> None:
        """
        Args:
            expression: a truth value over the column `reward`.
            reward: the reward's expression in the run; where it is a column's name, that name means
                the reward, too.
        """
        self._expression = expression
        self._names = {schema.REWARD.casefold(): schema.REWARD}
        if reward.isidentifier():
            self._names.setdefault(reward.casefold(), reward)
        self._of(np.zeros(1))  # so that an unusable expression is refused at once

    def __call__(self, store: EpisodeStore, rewards: Array) -> BoolArray:
        """(N,) of N steps of `store`, given their rewards (N,)."""
        values, places = np.unique(rewards, return_inverse=True)
        # The shortest decimals: as float64, 0.7 of float32 would be less than 0.7.
        return self._of(values.astype(str).astype(np.float64))[places]

    def __str__(self) -> str:
        return str(self._expression)

    def _of(self, rewards: Array) -> BoolArray:
        source = Path(_ROWS)
        types = tuple((name, "DOUBLE") for name in self._names.values())
        table = FrameTable((source,), types)
        with engine_in_memory() as connection, explained(connection, (table,), source):
            connection.register(_ROWS, pa.table({name: rewards for name, _ in types}))
            sql, kind, *_ = bind(connection, table, "for --liked", self._expression)
            if kind != "BOOLEAN":
                raise InputError(
                    f"{self._expression.origin} {self._expression} is {kind}, not true or false; "
                    f"compare it with something, such as {schema.REWARD} >= 4"
                )
            rows = connection.sql(f"SELECT COALESCE({sql}, false) FROM {table.sql}").fetchall()
        return np.fromiter((liked for (liked,) in rows), dtype=bool, count=len(rewards))
