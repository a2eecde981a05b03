"""The interface that both Taobao worlds have, and what can be said of either through it."""

from abc import abstractmethod
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from ucfrec.acting.rollout import BoolArray, FloatArray, IntArray
from ucfrec.errors import InputError
from ucfrec_simulators.behaviors import Constant
from ucfrec_simulators.session_env import AnyArray, SessionsEnv

ATTRIBUTES: Final = (8, 8, 11, 11, 11, 11, 2, 2, 3, 18, 3)
"""Values of each of the eleven user attributes; one-hot, they are the 88 user bits."""
USER_BITS: Final = sum(ATTRIBUTES)
ACTION_DIM: Final = 27
MAX_CLICKS: Final = 10
PAGE_INDICES: Final = 10
LONGEST_SESSION: Final = 100


class TaobaoEnv(SessionsEnv):
    """A shopper turns pages; each page is ranked by a weight vector and earns 0 to 10 clicks.

    Observation (91,): 88 one-hot user bits, clicks on the last page, the last page index (0–9, a
    second output of the user's model), pages turned so far. Action (27,) in [−1, 1]. Reward: the
    page's clicks. A session terminates when the user has turned as many pages as drawn at its
    start; it is never truncated. `info["CTR"]`: clicks per ten items shown, so far.
    """

    def __init__(self, num_envs: int) -> None:
        high = np.ones(USER_BITS + 3, dtype=np.float32)
        high[USER_BITS:] = MAX_CLICKS, PAGE_INDICES - 1, LONGEST_SESSION
        super().__init__(
            num_envs,
            spaces.Box(np.zeros_like(high), high, dtype=np.float32),
            spaces.Box(-1.0, 1.0, (ACTION_DIM,), dtype=np.float32),
        )
        self._users = np.zeros((num_envs, USER_BITS), dtype=np.float32)
        self._last = np.zeros((num_envs, 2), dtype=np.float32)
        self._pages, self._lengths, self._clicks = np.zeros((3, num_envs), dtype=np.int64)

    @abstractmethod
    def sample_users(
        self, count: int, generator: np.random.Generator
    ) -> tuple[FloatArray, IntArray]:
        """Draw users and how many pages they turn: (M, 88) one-hot bits, (M,) at least 1."""

    @abstractmethod
    def expected_clicks(
        self, users: FloatArray, pages: AnyArray, actions: FloatArray
    ) -> npt.NDArray[np.float64]:
        """Expected clicks of a page, exactly.

        Args:
            users: (M, 88) one-hot bits.
            pages: (M,) pages turned before, from 0.
            actions: (M, 27).

        Returns:
            (M,), 0 to 10.
        """

    @abstractmethod
    def _respond(
        self, users: FloatArray, pages: IntArray, actions: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Sample clicks (N,) and page indices (N,) from the environment's generator."""

    def _begin(self, rows: IntArray) -> None:
        self._users[rows], self._lengths[rows] = self.sample_users(len(rows), self.np_random)
        self._last[rows] = self._pages[rows] = self._clicks[rows] = 0

    def _play(self, actions: AnyArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        clicks, indices = self._respond(self._users, self._pages, actions)
        self._last[:, 0], self._last[:, 1] = clicks, indices
        self._clicks += clicks
        self._pages += 1
        left = self._pages >= self._lengths
        return clicks.astype(np.float32), left, np.zeros_like(left)

    def _observe(self) -> FloatArray:
        pages = self._pages[:, None].astype(np.float32)
        return np.concatenate([self._users, self._last, pages], axis=1)

    def _describe(self) -> dict[str, AnyArray]:
        return {"CTR": self._clicks / np.maximum(self._pages, 1) / MAX_CLICKS}


def split_observations(observations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Users (M, 88) and pages turned (M,) of observations (M, 91)."""
    return observations[:, :USER_BITS], observations[:, -1]


def taobao(env: VectorEnv[Any, Any, Any]) -> TaobaoEnv:
    """The environment as one whose users can be read.

    Raises:
        InputError: it is not a Taobao world.
    """
    if not isinstance(env.unwrapped, TaobaoEnv):
        raise InputError(f"this behavior policy serves Taobao worlds, not {type(env).__name__}")
    return env.unwrapped


def default_action() -> FloatArray:
    """A weight vector (27,) that nobody tuned: one uniform draw from the box, always the same."""
    return np.random.default_rng([0, 11]).uniform(-1, 1, ACTION_DIM).astype(np.float32)


def best_constant(
    env: TaobaoEnv,
    seed: int,
    restarts: int = 16,
    pages: int = 64,
    candidates: int = 160,
    elite: int = 16,
    rounds: int = 15,
) -> FloatArray:
    """The action vector (27,) with the highest expected clicks over all users' pages.

    The best of `restarts` cross-entropy searches, since one may end on a lower hill: `candidates`
    normal draws a round, judged on `pages` pages drawn anew, give the next round's mean and spread.
    It reads the world's expectations, as no recommender can, and draws its users from a stream of
    its own, apart from every episode played.
    """
    generator = np.random.default_rng([seed, 12])
    users, lengths = env.sample_users(40 * pages, generator)
    owner = np.repeat(np.arange(len(users)), lengths)
    page = np.arange(len(owner)) - np.repeat(np.cumsum(lengths) - lengths, lengths)

    def judge(actions: FloatArray, count: int) -> FloatArray:  # (M, 27) -> (M,) clicks a page
        judged = generator.choice(len(owner), size=count, replace=False)
        clicks = env.expected_clicks(
            np.tile(users[owner[judged]], (len(actions), 1)),
            np.tile(page[judged], len(actions)),
            np.repeat(actions, count, axis=0),
        )
        return np.asarray(clicks.reshape(len(actions), count).mean(1), dtype=np.float32)

    found = []
    for _ in range(restarts):
        mean, spread = np.zeros(ACTION_DIM), np.full(ACTION_DIM, 0.6)
        for _ in range(rounds):
            drawn = mean + spread * generator.standard_normal((candidates, ACTION_DIM))
            actions = np.clip(drawn, -1, 1).astype(np.float32)
            best = actions[np.argsort(judge(actions, pages))[-elite:]]
            mean, spread = best.mean(0), best.std(0) + 0.02
        found.append(np.clip(mean, -1, 1).astype(np.float32))
    return found[int(np.argmax(judge(np.stack(found), 10 * pages)))]


def zero_actor(env: VectorEnv[Any, Any, Any], seed: int) -> Constant:
    """The zero action always."""
    return Constant(np.zeros(ACTION_DIM, dtype=np.float32))


def best_constant_actor(env: VectorEnv[Any, Any, Any], seed: int) -> Constant:
    """The best constant action always: a baseline that knows nobody."""
    return Constant(best_constant(taobao(env), seed))
