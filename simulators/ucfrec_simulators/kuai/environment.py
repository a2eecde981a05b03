"""The Kuaishou environments: one item per step, rewards from a user × item table, exit by repeated
tags.

Source: `BaseEnv`, `KuaiEnv` and `KuaiRandEnv` of EasyRL4Rec, and their versions in DORL and CIRS.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import pyarrow as pa
from gymnasium import spaces

from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.schema import FORBIDDEN, USER_IDS
from ucfrec_simulators.session_env import SessionsEnv

UNTAGGED: Final = -1
"""The tag of all items without one; it counts for the exit rule like any other."""
NOT_SHOWN: Final = -1


@dataclass(frozen=True)
class ExitRule:
    """When a user leaves: a tag of the current item occurred too often in the items just before.

    In step t > 0 the user leaves if any tag of the item occurs more than `threshold` times among
    the pooled tags of the `window` items before it. Step t = 0 never ends a session by this rule.
    """

    window: int
    """Number of previous items that count."""
    threshold: int
    """Occurrences of a tag in the window that a user tolerates."""
    max_turn: int
    """Largest number of steps of a session."""


EXITS: Final = {
    "class-default": ExitRule(window=5, threshold=1, max_turn=100),
    "easyrl4rec-kuairec": ExitRule(window=9, threshold=1, max_turn=30),
    "easyrl4rec-kuairand": ExitRule(window=10, threshold=0, max_turn=30),
    "dorl": ExitRule(window=10, threshold=0, max_turn=30),
    "dorl-main": ExitRule(window=1, threshold=0, max_turn=30),
    "dorl-main-explore": ExitRule(window=4, threshold=0, max_turn=30),
    "cirs": ExitRule(window=1, threshold=0, max_turn=30),
}
"""Published settings by name; `dorl-main-explore` is that of DORL's UCB and ε-greedy scripts. The
published code looks back at fewer items in the first steps of a session: its slice
`shown[t − window : t]` starts below 0, which Python counts from the end."""


@dataclass(frozen=True)
class Regime:
    """How an evaluation is run."""

    masked: bool
    """Whether an item may be recommended only once per session."""
    steps: int | None = None
    """Fixed number of steps of a session; None: sessions end by the exit rule."""


REGIMES: Final = {"FB": Regime(False), "NX_0": Regime(True), "NX_10": Regime(True, 10)}
"""The evaluation settings of the public experiments, by their name."""


class Rewards(Protocol):
    """The reward of every user for every item."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_users, n_items)."""

    def __getitem__(self, pairs: tuple[IntArray, IntArray]) -> Array:
        """Rewards (...) of aligned users (...) and items (...), indexed as a NumPy array."""


class KuaiEnv(SessionsEnv):
    """One item per step to a user drawn uniformly; the reward is the table's entry.

    A session terminates in the step whose item triggers the `ExitRule`, and the reward of that step
    counts. It is truncated at its maximum length. If the regime masks items, showing an item twice
    in a session is an error: `info["forbidden"]` (N, maximum length) lists the items already shown,
    padded with −1.

    Observation (2,): row of the user in the table, and column of the last item (n_items before the
    first). `info["user_id"]` (N,): id of the user of the next step.

    Args:
        num_envs: number of parallel sessions, N.
        rewards: (n_users, n_items), an array or an object indexed like one.
        tags: tags of each item; an item without any gets the tag −1.
        exit_rule: when users leave.
        regime: masking and length of sessions.
        user_ids, item_ids: (n_users,) and (n_items,) ids in the logs; row and column numbers if
            None.

    Raises:
        InputError: tags or ids do not match the table, or there are fewer items than steps of a
            masked session. In `step`: a masked item was shown.
    """

    def __init__(
        self,
        num_envs: int,
        rewards: Rewards,
        tags: Sequence[Sequence[int]],
        exit_rule: ExitRule,
        regime: Regime = REGIMES["FB"],
        user_ids: IntArray | None = None,
        item_ids: IntArray | None = None,
    ) -> None:
        n_users, n_items = rewards.shape
        self.user_ids = np.arange(n_users) if user_ids is None else user_ids
        self.item_ids = np.arange(n_items) if item_ids is None else item_ids
        sizes = (len(self.user_ids), len(self.item_ids), len(tags))
        if sizes != (n_users, n_items, n_items):
            raise InputError(
                f"the table has {n_users} users × {n_items} items, but there are {sizes[0]} user "
                f"ids, {sizes[1]} item ids and tags of {sizes[2]} items; give the same numbers"
            )
        longest = exit_rule.max_turn if regime.steps is None else regime.steps
        if regime.masked and n_items < longest:
            raise InputError(
                f"{n_items} items are too few for a session of {longest} steps without repeats"
            )
        self.rewards, self.exit_rule, self.regime = rewards, exit_rule, regime
        self.tags = [tuple(item_tags) or (UNTAGGED,) for item_tags in tags]
        """Tags of each item; at least one."""
        self._codes, self._n_tags = _encode_tags(self.tags)
        self.users: IntArray = np.zeros(num_envs, dtype=np.int64)
        """(N,) table row of each session's user."""
        self.turns: IntArray = np.zeros(num_envs, dtype=np.int64)
        """(N,) number of items shown so far."""
        self._shown: IntArray = np.full((num_envs, longest), NOT_SHOWN)
        high = np.array([n_users - 1, n_items], dtype=np.float32)
        super().__init__(
            num_envs,
            spaces.Box(np.zeros(2, dtype=np.float32), high, dtype=np.float32),
            spaces.Discrete(n_items),
        )

    def item_features(self) -> pa.Table:
        """One row per item, in the order of the table's columns: `item_id` and the list `tags`."""
        return pa.table({"item_id": pa.array(self.item_ids), "tags": pa.array(self.tags)})

    def boring(self, exit_rule: ExitRule | None = None) -> BoolArray:
        """(N, n_items) whether each item would end each session in this step by an exit rule, the
        environment's if None."""
        tiresome = self._tiresome(exit_rule or self.exit_rule)
        boring = np.zeros((self.num_envs, len(self._codes)), dtype=np.bool_)
        for codes in self._codes.T:
            boring |= tiresome[:, codes]
        return boring

    def _tiresome(self, exit_rule: ExitRule) -> BoolArray:
        """(N, n_tags + 1) whether each tag occurred too often; the last column is padding."""
        size, reach = self._n_tags + 1, np.minimum(self.turns, exit_rule.window)
        # One entry per remembered item: its session, and its step in that session.
        rows = np.repeat(np.arange(self.num_envs), reach)
        steps = np.arange(len(rows)) + np.repeat(self.turns - np.cumsum(reach), reach)
        remembered = self._shown[rows, steps]
        cells = rows[:, None] * size + self._codes[remembered]
        counts = np.bincount(cells.ravel(), minlength=self.num_envs * size)
        tiresome: BoolArray = counts.reshape(self.num_envs, size) > exit_rule.threshold
        tiresome[:, -1] = False
        return tiresome

    def leave_out_masked(self, scores: Array) -> None:
        """Set `scores` (N, n_items) of the items that the regime masks to −∞, in place."""
        if self.regime.masked:
            rows, places = np.nonzero(self._shown != NOT_SHOWN)
            scores[rows, self._shown[rows, places]] = -np.inf

    def _begin(self, rows: IntArray) -> None:
        self.users[rows] = self.np_random.integers(len(self.user_ids), size=len(rows))
        self.turns[rows] = 0
        self._shown[rows] = NOT_SHOWN

    def _play(self, actions: Array) -> tuple[Float32Array, BoolArray, BoolArray]:
        rows = np.arange(self.num_envs)
        if self.regime.masked:
            self._require_new(actions)
        rewards = np.asarray(self.rewards[self.users, actions], dtype=np.float32)
        bored = np.zeros(self.num_envs, dtype=np.bool_)
        if self.regime.steps is None:
            tiresome = self._tiresome(self.exit_rule)
            bored |= tiresome[rows[:, None], self._codes[actions]].any(axis=1)
        self._shown[rows, self.turns] = actions
        self.turns += 1
        return rewards, bored, np.asarray((self.turns >= self._shown.shape[1]) & ~bored)

    def _require_new(self, actions: Array) -> None:
        repeated = (self._shown == actions[:, None]).any(axis=1)
        if repeated.any():
            raise InputError(
                f"{repeated.sum()} of {self.num_envs} sessions repeat an item (such as "
                f'{actions[repeated][0]}), which this regime masks; avoid info["{FORBIDDEN}"]'
            )

    def _observe(self) -> Float32Array:
        last = self._shown[np.arange(self.num_envs), np.maximum(self.turns - 1, 0)]
        last = np.where(self.turns == 0, len(self.item_ids), last)
        return np.stack([self.users, last], axis=1).astype(np.float32)

    def _describe(self) -> dict[str, Array]:
        info: dict[str, Array] = {USER_IDS: self.user_ids[self.users]}
        return info | {FORBIDDEN: self._shown.copy()} if self.regime.masked else info


def _encode_tags(tags: Sequence[Sequence[int]]) -> tuple[IntArray, int]:
    """(n_items, most tags of an item) tags numbered from 0, padded with their count; the count."""
    lengths = np.array([len(item_tags) for item_tags in tags])
    flat = np.array([tag for item_tags in tags for tag in item_tags], dtype=np.int64)
    distinct, numbers = np.unique(flat, return_inverse=True)
    codes = np.full((len(tags), lengths.max()), len(distinct), dtype=np.int64)
    codes[np.arange(codes.shape[1]) < lengths[:, None]] = numbers
    return codes, len(distinct)
