"""Built-in policies of the Kuaishou environments: two floors, and a ceiling."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from gymnasium.vector import VectorEnv

from ucfrec.acting.rollout import Actor
from ucfrec.acting.uniform import Memoryless, Uniform
from ucfrec.arrays import BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec_simulators.kuai.environment import ExitRule, KuaiEnv

MASK: Final = ExitRule(window=10, threshold=0, max_turn=100)
"""Whose tags `random-mask` leaves out: those of the last ten items, in every environment."""


class RandomMask(Memoryless):
    """A uniformly random item without a tag of the last ten, and that is not masked.

    If there is none, any item that is not masked. It knows no rewards: a floor for what a policy
    earns by not repeating itself.
    """

    def __init__(self, environment: KuaiEnv, seed: int) -> None:
        self._environment, self._generator = environment, np.random.default_rng([seed, 1])

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[IntArray, None]:
        """An item of each session, (N,)."""
        repeated = self._environment.boring(MASK)
        drawn = self._generator.random(repeated.shape) - repeated
        self._environment.leave_out_masked(drawn)
        return drawn.argmax(axis=1), None

    def inform(self, info: Mapping[str, Any]) -> None:
        """Do nothing: the environment itself is read instead of `info`."""


class Oracle(Memoryless):
    """The item of highest true reward that is not masked and does not end the session.

    It reads the environment's rewards, which no recommender can. It is greedy and so not optimal:
    it does not plan beyond the current step. If every item left ends the session, it plays the one
    of highest reward.
    """

    def __init__(self, environment: KuaiEnv) -> None:
        self._environment = environment

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[IntArray, None]:
        """The best item of each session, (N,)."""
        environment, items = self._environment, np.arange(len(self._environment.item_ids))
        users = np.broadcast_to(environment.users[:, None], (environment.num_envs, len(items)))
        rewards = np.array(
            environment.rewards[users, np.broadcast_to(items, users.shape)], dtype=np.float64
        )
        if environment.regime.steps is None:
            # Shift boring items below all others, so that they are chosen last.
            rewards -= environment.boring() * (1 + np.ptp(rewards))
        environment.leave_out_masked(rewards)
        return rewards.argmax(axis=1), None

    def inform(self, info: Mapping[str, Any]) -> None:
        """Do nothing: the environment itself is read instead of `info`."""


def oracle(env: VectorEnv[Any, Any, Any], seed: int) -> Oracle:
    """The greedy policy that knows every reward; `seed` is unused.

    Raises:
        InputError: `env` is not a Kuaishou environment.
    """
    return Oracle(_environment(env))


def random_mask(env: VectorEnv[Any, Any, Any], seed: int) -> RandomMask:
    """Random items whose tags were not shown lately.

    Raises:
        InputError: `env` is not a Kuaishou environment.
    """
    return RandomMask(_environment(env), seed)


def _environment(env: VectorEnv[Any, Any, Any]) -> KuaiEnv:
    if not isinstance(env.unwrapped, KuaiEnv):
        raise InputError(f"this behavior policy serves KuaiEnv, not {type(env).__name__}")
    return env.unwrapped


BEHAVIORS: Final[Mapping[str, Callable[[VectorEnv[Any, Any, Any], int], Actor]]] = {
    "random": Uniform,
    "random-mask": random_mask,
    "oracle": oracle,
}
"""Built-in policies of the Kuaishou environments."""
