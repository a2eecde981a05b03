"""The interface of the Taobao environments, and the behavior policies that need only this
interface."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Final

import numpy as np
from gymnasium import spaces

from ucfrec.acting.rollout import Actor, Uniform
from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError
from ucfrec_simulators.behaviors import Blend, Rule, SessionMixture, repeat_action
from ucfrec_simulators.session_env import AnyEnv, SessionsEnv

ATTRIBUTES: Final = (8, 8, 11, 11, 11, 11, 2, 2, 3, 18, 3)
"""Number of values of each of the eleven user attributes; one-hot, they give the 88 user bits."""
USER_BITS: Final = sum(ATTRIBUTES)
ACTION_DIM: Final = 27
MAX_CLICKS: Final = 10
PAGE_INDICES: Final = 10
LONGEST_SESSION: Final = 100


class TaobaoEnv(SessionsEnv):
    """A user turns pages; each page is ranked by a weight vector and gets 0 to 10 clicks.

    Observation (91,): 88 one-hot user bits, clicks on the last page, the last page index (0–9, a
    second output of the user's model), pages turned so far. Action (27,) in [−1, 1]. Reward: the
    page's clicks. A session terminates when the user has turned as many pages as drawn at its
    start; it is never truncated. `info["CTR"]` (N,): clicks so far divided by items shown.
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
    ) -> tuple[Float32Array, IntArray]:
        """Draw M = `count` users: one-hot bits (M, 88), and pages they turn (M,), at least 1."""

    @abstractmethod
    def expected_clicks(
        self, users: Float32Array, pages: Array, actions: Float32Array
    ) -> Float64Array:
        """Exact expected clicks (M,) on a page, 0 to 10, of users (M, 88) after pages (M,) turned,
        by weight vectors (M, 27)."""

    @abstractmethod
    def _respond(
        self, users: Float32Array, pages: IntArray, actions: Float32Array
    ) -> tuple[IntArray, IntArray]:
        """Sample clicks (N,) and page indices (N,) from the environment's generator."""

    def _begin(self, rows: IntArray) -> None:
        self._users[rows], self._lengths[rows] = self.sample_users(len(rows), self.np_random)
        self._last[rows] = self._pages[rows] = self._clicks[rows] = 0

    def _play(self, actions: Array) -> tuple[Float32Array, BoolArray, BoolArray]:
        clicks, indices = self._respond(self._users, self._pages, actions)
        self._last[:, 0], self._last[:, 1] = clicks, indices
        self._clicks += clicks
        self._pages += 1
        left = self._pages >= self._lengths
        return clicks.astype(np.float32), left, np.zeros_like(left)

    def _observe(self) -> Float32Array:
        pages = self._pages[:, None].astype(np.float32)
        return np.concatenate([self._users, self._last, pages], axis=1)

    def _describe(self) -> dict[str, Array]:
        return {"CTR": self._clicks / np.maximum(self._pages, 1) / MAX_CLICKS}


def split_observations(observations: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Split observations (M, 91) into user bits (M, 88) and pages turned (M,)."""
    return observations[:, :USER_BITS], observations[:, -1]


def taobao(env: AnyEnv) -> TaobaoEnv:
    """The Taobao environment within `env`.

    Raises:
        InputError: `env` is not a Taobao environment.
    """
    if not isinstance(env.unwrapped, TaobaoEnv):
        raise InputError(
            f"this behavior policy serves Taobao environments, not {type(env).__name__}"
        )
    return env.unwrapped


def best_constant(env: TaobaoEnv, seed: int) -> Float32Array:
    """The constant action vector (27,) with the highest expected clicks over all users' pages.

    The best result of several cross-entropy searches, since one may end in a local optimum. It uses
    the environment's expected clicks, which no recommender can, and draws its users from a separate
    random stream, independent of all episodes.
    """
    restarts, rounds = 16, 15
    # A round scores 160 actions on 64 new pages; the best 16 give the next mean and spread.
    pages, candidates, elite = 64, 160, 16
    generator = np.random.default_rng([seed, 12])
    users, lengths = env.sample_users(40 * pages, generator)
    owner = np.repeat(np.arange(len(users)), lengths)
    page = np.arange(len(owner)) - np.repeat(np.cumsum(lengths) - lengths, lengths)

    def mean_clicks(actions: Float32Array, count: int) -> Float32Array:  # (M, 27) -> (M,)
        sample = generator.choice(len(owner), size=count, replace=False)
        clicks = env.expected_clicks(
            np.tile(users[owner[sample]], (len(actions), 1)),
            np.tile(page[sample], len(actions)),
            np.repeat(actions, count, axis=0),
        )
        return np.asarray(clicks.reshape(len(actions), count).mean(1), dtype=np.float32)

    optima = []
    for _ in range(restarts):
        mean, spread = np.zeros(ACTION_DIM), np.full(ACTION_DIM, 0.6)
        for _ in range(rounds):
            samples = mean + spread * generator.standard_normal((candidates, ACTION_DIM))
            actions = np.clip(samples, -1, 1).astype(np.float32)
            best = actions[np.argsort(mean_clicks(actions, pages))[-elite:]]
            mean, spread = best.mean(0), best.std(0) + 0.02
        optima.append(np.clip(mean, -1, 1).astype(np.float32))
    return optima[int(np.argmax(mean_clicks(np.stack(optima), 10 * pages)))]


def mix_blends(
    env: AnyEnv,
    seed: int,
    best: Actor,
    uniform: float,
    qualities: Sequence[tuple[float, float, float]],
) -> SessionMixture:
    """Uniform actions in a share of the sessions, in others noisy blends of an untuned constant
    with the actions of `best`.

    Args:
        qualities: quality, noise and share of sessions of each blend.
    """
    default = np.random.default_rng([0, 11]).uniform(-1, 1, ACTION_DIM).astype(np.float32)
    blends = [Blend(best, default, quality, noise, seed) for quality, noise, _ in qualities]
    shares = [uniform, *(share for _, _, share in qualities)]
    return SessionMixture([Uniform(env, seed), *blends], shares, seed)


def zero_actor(env: AnyEnv, seed: int) -> Rule:
    """A policy that always takes the zero action; `seed` is unused."""
    return repeat_action(np.zeros(ACTION_DIM, dtype=np.float32))


def best_constant_actor(env: AnyEnv, seed: int) -> Rule:
    """A non-personalised baseline: always the action of `best_constant`."""
    return repeat_action(best_constant(taobao(env), seed))
