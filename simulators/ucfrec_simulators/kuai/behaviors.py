"""Built-in policies of the Kuaishou environments (two baselines, an oracle), and simulators."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np

from ucfrec.acting.rollout import Actor, Memoryless, Uniform
from ucfrec.arrays import BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.evaluation.simulator import Simulator
from ucfrec_simulators.kuai.environment import EXITS, REGIMES, ExitRule, KuaiEnv
from ucfrec_simulators.session_env import AnyEnv

MASK: Final = ExitRule(window=10, threshold=0, max_turn=100)
"""Whose tags `random-mask` excludes: those of the last ten items, in every environment."""


class _Insider(Memoryless):
    """A policy that reads the environment itself, not what `info` says of it."""

    def __init__(self, env: AnyEnv, seed: int) -> None:
        if not isinstance(env.unwrapped, KuaiEnv):
            raise InputError(f"this behavior policy serves KuaiEnv, not {type(env).__name__}")
        self._environment, self._generator = env.unwrapped, np.random.default_rng([seed, 1])

    def inform(self, info: Mapping[str, Any]) -> None:
        """Do nothing."""


class RandomMask(_Insider):
    """A uniformly random item without a tag of the last ten, and that is not masked.

    If there is none, any item that is not masked. It uses no rewards: a baseline for what not
    repeating itself is worth.
    """

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[IntArray, None]:
        """An item of each session, (N,)."""
        repeated = self._environment.boring(MASK)
        priorities = self._generator.random(repeated.shape) - repeated
        self._environment.leave_out_masked(priorities)
        return priorities.argmax(axis=1), None


class Oracle(_Insider):
    """The item of highest true reward that is not masked and does not end the session.

    It reads the environment's rewards, which no recommender can. It is greedy and so not optimal:
    it does not plan beyond the current step. If every item left ends the session, it shows the one
    of highest reward.
    """

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


BEHAVIORS: Final[Mapping[str, Callable[[AnyEnv, int], Actor]]] = {
    "random": Uniform,
    "random-mask": RandomMask,
    "oracle": Oracle,
}
"""Built-in policies of the Kuaishou environments."""


def simulators(
    make: Callable[..., KuaiEnv], own_exit: ExitRule, summary: str, feedback: str
) -> tuple[Simulator, ...]:
    """The published variants of an environment, for the command line.

    Args:
        make: makes the environment of this number of sessions, from a folder, with an exit rule
            and a regime.
        own_exit: the environment's exit rule in EasyRL4Rec.
        feedback: column of the reward in the logs.

    Returns:
        Regimes FB, NX_0 and NX_10 with `own_exit`, then FB and NX_0 with DORL's exit rules of four
        items and of one item.
    """
    four, single = EXITS["dorl-main-explore"], EXITS["dorl-main"]
    variants = [("FB", own_exit), ("NX_0", own_exit), ("NX_10", own_exit)]
    variants += [("FB", four), ("NX_0", four), ("FB", single), ("NX_0", single)]
    return tuple(
        Simulator(
            summary=f"{summary}; {_describe(regime, exit_rule)}",
            make=partial(make, exit_rule=exit_rule, regime=REGIMES[regime]),
            behaviors=BEHAVIORS,
            feedback=feedback,
        )
        for regime, exit_rule in variants
    )


def _describe(regime: str, exit_rule: ExitRule) -> str:
    """A regime, by its name, and an exit rule, in words."""
    if REGIMES[regime].steps is not None:
        return f"regime {regime}"
    times = "a tag" if exit_rule.threshold == 0 else f"a tag shown {exit_rule.threshold + 1} times"
    return f"regime {regime}; users leave at {times} among the {exit_rule.window} items before"
