"""The Kuaishou worlds: a user, an item a step, a user × item table of rewards, boredom by tags.

Facts: `BaseEnv`, `KuaiEnv` and `KuaiRandEnv` of EasyRL4Rec, and their relatives in DORL and CIRS.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from ucfrec.acting.rollout import FORBIDDEN, USER_IDS, BoolArray, FloatArray, IntArray
from ucfrec.errors import InputError
from ucfrec_simulators.behaviors import Memoryless
from ucfrec_simulators.session_env import AnyArray, SessionsEnv

UNTAGGED: Final = -1
"""The tag that all items without one share; it bores like any other."""
NOT_SHOWN: Final = -1


@dataclass(frozen=True)
class ExitRule:
    """When a user leaves: a tag of the item shown occurred too often just before.

    In step t > 0 (t = 0 never ends a session by this rule) the user leaves if any tag of the item
    occurs more than `threshold` times among the tags, pooled, of the `window` items before it.
    """

    window: int
    threshold: int
    max_turn: int
    """Steps after which a session is over in any case."""
    sliced: bool = False
    """Windows of the original code: its slice `shown[t − window : t]` starts at a negative number
    for t < window, which Python counts from the end, so that step t looks back at only
    min(t, window − t) items instead of t."""

    def reach(self, turns: IntArray) -> IntArray:
        """How many items back the user remembers before step `turns`."""
        early = np.minimum(turns, self.window - turns) if self.sliced else turns
        return np.where(turns < self.window, early, self.window)


EXITS: Final = {
    "class-default": ExitRule(window=5, threshold=1, max_turn=100),
    "easyrl4rec-kuairec": ExitRule(window=9, threshold=1, max_turn=30),
    "easyrl4rec-kuairand": ExitRule(window=10, threshold=0, max_turn=30),
    "dorl": ExitRule(window=10, threshold=0, max_turn=30),
    "dorl-main": ExitRule(window=1, threshold=0, max_turn=30),
    "dorl-main-explore": ExitRule(window=4, threshold=0, max_turn=30),
    "cirs": ExitRule(window=1, threshold=0, max_turn=30),
}
"""Published settings by name. `dorl-main-explore` is that of its UCB and ε-greedy scripts. With
`dataclasses.replace(rule, sliced=True)` they are what the published code computes."""


@dataclass(frozen=True)
class Regime:
    """How an evaluation is played."""

    masked: bool
    """Items may be recommended once a session only."""
    steps: int | None = None
    """Sessions of exactly so many steps, whatever the exit rule; None leaves them to it."""


REGIMES: Final = {"FB": Regime(False), "NX_0": Regime(True), "NX_10": Regime(True, 10)}


class Rewards(Protocol):
    """What every user pays for every item."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_users, n_items)."""

    def __getitem__(self, pairs: tuple[IntArray, IntArray]) -> npt.NDArray[Any]:
        """Rewards of aligned users (...) and items (...), as of a NumPy array."""


class KuaiEnv(SessionsEnv):
    """One item a step to a user drawn uniformly; the reward is the table's entry.

    A session terminates in the step whose item bores (`ExitRule`), that step's reward counting, and
    is truncated at its longest. Where the regime masks, an item played twice is an error:
    `info["forbidden"]` (N, longest) lists the items already shown, −1 where there is none.

    Observation (2,): number of the user, number of the last item (n_items before the first).
    `info["user_id"]` (N,): whom the next step serves. Numbers count rows and columns of the table.

    Args:
        num_envs: sessions side by side, N.
        rewards: (n_users, n_items), an array or something that is indexed like one.
        tags: of each item; none stands for the tag −1.
        exit_rule: when users leave.
        regime: how it is played.
        user_ids, item_ids: what the logs call them.

    Raises:
        InputError: tags or ids do not fit the table, or fewer items than a masked session shows.
            On a step, a masked item.
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
        given = (len(self.user_ids), len(self.item_ids), len(tags))
        if given != (n_users, n_items, n_items):
            raise InputError(
                f"a table of {n_users} users × {n_items} items came with {given[0]} user ids, "
                f"{given[1]} item ids and tags of {given[2]} items"
            )
        longest = exit_rule.max_turn if regime.steps is None else regime.steps
        if regime.masked and n_items < longest:
            raise InputError(f"{n_items} items cannot fill a session of {longest} without repeats")
        self.rewards, self.exit_rule, self.regime = rewards, exit_rule, regime
        self.tags = [tuple(own) or (UNTAGGED,) for own in tags]
        """Of each item; at least one."""
        self._codes, self._n_tags = _coded(self.tags)
        self.users: IntArray = np.zeros(num_envs, dtype=np.int64)
        """(N,) who is served."""
        self.turns: IntArray = np.zeros(num_envs, dtype=np.int64)
        """(N,) items shown so far."""
        self._shown: IntArray = np.full((num_envs, longest), NOT_SHOWN)
        high = np.array([n_users - 1, n_items], dtype=np.float32)
        super().__init__(
            num_envs,
            spaces.Box(np.zeros(2, dtype=np.float32), high, dtype=np.float32),
            spaces.Discrete(n_items),
        )

    def item_features(self) -> pa.Table:
        """One row an item, in the order of their numbers: `item_id` and the list `tags`."""
        return pa.table({"item_id": pa.array(self.item_ids), "tags": pa.array(self.tags)})

    def boring(self) -> BoolArray:
        """Which items would end each session now, (N, n_items)."""
        tiresome = self._tiresome()
        found = np.zeros((self.num_envs, len(self._codes)), dtype=np.bool_)
        for place in self._codes.T:
            found |= tiresome[:, place]
        return found

    def _tiresome(self) -> BoolArray:
        """(N, n_tags + 1) tags that users have seen too often; the last one stands for none."""
        size, reach = self._n_tags + 1, self.exit_rule.reach(self.turns)
        # One entry a remembered item: its session, and its place in the session from the first.
        rows = np.repeat(np.arange(self.num_envs), reach)
        places = np.arange(len(rows)) + np.repeat(self.turns - np.cumsum(reach), reach)
        remembered = self._shown[rows, places]
        seen = rows[:, None] * size + self._codes[remembered]
        counts = np.bincount(seen.ravel(), minlength=self.num_envs * size)
        tiresome: BoolArray = counts.reshape(self.num_envs, size) > self.exit_rule.threshold
        tiresome[:, -1] = False
        return tiresome

    def _begin(self, rows: IntArray) -> None:
        self.users[rows] = self.np_random.integers(len(self.user_ids), size=len(rows))
        self.turns[rows] = 0
        self._shown[rows] = NOT_SHOWN

    def _play(self, actions: AnyArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        rows = np.arange(self.num_envs)
        if self.regime.masked:
            self._require_new(actions)
        rewards = np.asarray(self.rewards[self.users, actions], dtype=np.float32)
        if self.regime.steps is None:
            bored = np.asarray(self._tiresome()[rows[:, None], self._codes[actions]].any(axis=1))
        else:
            bored = np.zeros(self.num_envs, dtype=np.bool_)
        self._shown[rows, self.turns] = actions
        self.turns += 1
        return rewards, bored, np.asarray((self.turns >= self._shown.shape[1]) & ~bored)

    def _require_new(self, actions: AnyArray) -> None:
        again = (self._shown == actions[:, None]).any(axis=1)
        if again.any():
            raise InputError(
                f"{again.sum()} of {self.num_envs} sessions were shown an item again (such as "
                f'{actions[again][0]}), which this regime masks; heed info["{FORBIDDEN}"]'
            )

    def _observe(self) -> FloatArray:
        last = self._shown[np.arange(self.num_envs), np.maximum(self.turns - 1, 0)]
        last = np.where(self.turns == 0, len(self.item_ids), last)
        return np.stack([self.users, last], axis=1).astype(np.float32)

    def _describe(self) -> dict[str, AnyArray]:
        told: dict[str, AnyArray] = {USER_IDS: self.user_ids[self.users]}
        return told | {FORBIDDEN: self._shown.copy()} if self.regime.masked else told


def _coded(tags: Sequence[Sequence[int]]) -> tuple[IntArray, int]:
    """Tags numbered from 0, (n_items, most tags of an item), filled up with their count."""
    lengths = np.array([len(own) for own in tags])
    flat = np.array([tag for own in tags for tag in own], dtype=np.int64)
    known, numbers = np.unique(flat, return_inverse=True)
    codes = np.full((len(tags), lengths.max()), len(known), dtype=np.int64)
    codes[np.arange(codes.shape[1]) < lengths[:, None]] = numbers
    return codes, len(known)


class Oracle(Memoryless):
    """The dearest item that is neither forbidden nor boring, as only the world itself knows it.

    Not the optimum, as it plans no further than the step, but out of a recommender's reach. Where
    every item left would bore, the dearest of them ends the session.
    """

    def __init__(self, world: KuaiEnv) -> None:
        self._world = world

    def act(self, observations: FloatArray, live: BoolArray) -> tuple[IntArray, None]:
        """Choose an item a session, (N,)."""
        world, items = self._world, np.arange(len(self._world.item_ids))
        users = np.broadcast_to(world.users[:, None], (world.num_envs, len(items)))
        paid = np.array(world.rewards[users, np.broadcast_to(items, users.shape)], dtype=np.float64)
        if world.regime.steps is None:
            # Anything that bores comes after anything that does not.
            paid -= world.boring() * (1 + np.ptp(paid))
        if world.regime.masked:
            rows, places = np.nonzero(world._shown != NOT_SHOWN)
            paid[rows, world._shown[rows, places]] = -np.inf
        return paid.argmax(axis=1), None

    def inform(self, info: Mapping[str, Any]) -> None:
        """It knows all that already."""


def oracle(env: VectorEnv[Any, Any, Any], seed: int) -> Oracle:
    """The greedy policy of one who knows every reward.

    Raises:
        InputError: it is not a Kuaishou world.
    """
    if not isinstance(env.unwrapped, KuaiEnv):
        raise InputError(f"this behavior policy serves KuaiEnv, not {type(env).__name__}")
    return Oracle(env.unwrapped)
