"""A synthetic Taobao environment, without downloads and with a known optimal policy."""

from typing import Final

import numpy as np

from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.evaluation.simulator import Simulator
from ucfrec_simulators.behaviors import Rule, SessionMixture
from ucfrec_simulators.session_env import AnyEnv, draw_categories
from ucfrec_simulators.taobao import ddpg
from ucfrec_simulators.taobao.environment import (
    ACTION_DIM,
    ATTRIBUTES,
    LONGEST_SESSION,
    MAX_CLICKS,
    PAGE_INDICES,
    USER_BITS,
    TaobaoEnv,
    mix_blends,
    split_observations,
    taobao,
)

BEST_CLICK_PROBABILITY: Final = 0.9
TOLERANCE: Final = 0.1
"""Mean squared distance from the best action at which the click probability is a quarter."""


class SyntheticTaobao(TaobaoEnv):
    """The spaces and interface of `VirtualTaobao` with a synthetic user model.

    The best action of user u on page k is a*(u, k) = 0.9 tanh(b + Σ_g W_g[u_g] + d k / (k + 4)): a
    taste b common to all users, a taste W_g for each of the eleven attributes g, and a drift d.
    Each of a page's ten items is clicked with probability p = 0.9 / (1 + ‖a − a*‖² / (27 · 0.1))²,
    so clicks are Binomial(10, p), p is largest at a* only, and a* lies inside the box. Always
    taking a* is optimal, since actions do not affect the session's length. Lengths are log-normal
    with a median that depends on the attributes, rounded up, at most 100. The page index is uniform
    noise.

    Args:
        num_envs: number of parallel sessions, N.
        environment_seed: seed of the users' tastes; independent of the seed of `reset`.
    """

    def __init__(self, num_envs: int = 1, environment_seed: int = 0) -> None:
        super().__init__(num_envs)
        environment = np.random.default_rng([environment_seed, 21])
        per_attribute = 1 / np.sqrt(len(ATTRIBUTES))
        self._common = environment.normal(0, 0.45, ACTION_DIM)
        self._tastes = environment.normal(0, 0.35 * per_attribute, (USER_BITS, ACTION_DIM))
        self._drift = environment.normal(0, 0.25, ACTION_DIM)
        self._patience = environment.normal(0, 0.4 * per_attribute, USER_BITS)
        self._popularity = [environment.dirichlet(np.full(size, 2.0)) for size in ATTRIBUTES]

    def sample_users(
        self, count: int, generator: np.random.Generator
    ) -> tuple[Float32Array, IntArray]:
        """Draw M = `count` users: one-hot bits (M, 88), and pages they turn (M,), at least 1."""
        uniforms = generator.random((count, len(ATTRIBUTES)))
        bits = []
        for shares, uniform in zip(self._popularity, uniforms.T, strict=True):
            values = draw_categories(np.tile(shares, (count, 1)), uniform)
            bits.append(np.eye(len(shares), dtype=np.float32)[values])
        users = np.concatenate(bits, axis=1)
        logarithm = 1.5 + users @ self._patience + generator.normal(0, 1.0, count)
        return users, np.clip(np.ceil(np.exp(logarithm)), 1, LONGEST_SESSION).astype(np.int64)

    def best_actions(self, users: Float32Array, pages: Array) -> Float32Array:
        """Best actions a* (M, 27) of users (M, 88) after pages (M,) turned."""
        share = np.asarray(pages, dtype=np.float64) / (np.asarray(pages) + 4.0)
        taste = self._common + users @ self._tastes + share[:, None] * self._drift
        return (0.9 * np.tanh(taste)).astype(np.float32)

    def optimal_actions(self, observations: Float32Array) -> Float32Array:
        """Best actions a* (M, 27) for observations (M, 91)."""
        users, pages = split_observations(observations)
        return self.best_actions(users, pages)

    def expected_clicks(
        self, users: Float32Array, pages: Array, actions: Float32Array
    ) -> Float64Array:
        """Exact expected clicks (M,): users (M, 88), pages turned (M,), actions (M, 27)."""
        return MAX_CLICKS * self._click_probability(users, pages, actions)

    def _respond(
        self, users: Float32Array, pages: IntArray, actions: Float32Array
    ) -> tuple[IntArray, IntArray]:
        clicks = self.np_random.binomial(MAX_CLICKS, self._click_probability(users, pages, actions))
        return clicks, self.np_random.integers(PAGE_INDICES, size=len(users))

    def _click_probability(
        self, users: Float32Array, pages: Array, actions: Float32Array
    ) -> Float64Array:
        difference = actions.astype(np.float64) - self.best_actions(users, pages)
        distance = np.square(difference).mean(axis=1)
        return np.asarray(BEST_CLICK_PROBABILITY / (1 + distance / TOLERANCE) ** 2)


QUALITIES: Final = ((0.1, 0.2, 0.25), (0.4, 0.2, 0.25), (0.7, 0.2, 0.20), (0.95, 0.2, 0.10))
"""Blends of the mixture: quality, noise, share of sessions."""


def optimal(env: AnyEnv, seed: int) -> Rule:
    """The optimal policy, which always takes a*; `seed` is unused."""
    environment = taobao(env)
    assert isinstance(environment, SyntheticTaobao)
    return Rule(environment.optimal_actions)


def mixture(env: AnyEnv, seed: int) -> SessionMixture:
    """A logging policy of medium mean quality and high variance between sessions.

    A fifth of the sessions get uniform actions, the others a noisy blend of an untuned constant
    and the user's best action (`QUALITIES`).
    """
    return mix_blends(env, seed, optimal(env, seed), 0.2, QUALITIES)


SIMULATOR: Final = Simulator(
    summary="built-in users with a known best action: 27 ranking weights per page, 0-10 clicks",
    make=lambda num_envs, folder: SyntheticTaobao(num_envs),
    behaviors={**ddpg.COMMON, "mixture": mixture, "optimal": optimal},
    feedback="clicks",
)
