"""SARDINE's environments of single items: tastes that only feedback reveals, and satiation.

SARDINE is the simulator of Deffayet et al. (2024), the package `sardine-rec` (extra `sardine`),
which is used as published. A session has 100 steps. One of 1,000 items is shown in each and
clicked or not; an item is a vector of 10 topics, of which two or three are not zero. A user with
tastes for 3 to 5 topics is drawn for every session. Nothing is observed besides what was shown and
clicked. In `Static` tastes stay as they are. In `BoredInf` clicks change them, and a user who
clicked 5 items with the same main topic within 5 steps likes nothing for 5 steps.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import gymnasium
import numpy as np
import pyarrow as pa

from ucfrec.acting.rollout import Uniform
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.evaluation.gymnasium_environment import GymnasiumCatalog
from ucfrec.evaluation.simulator import Simulator
from ucfrec.schema import ITEM_ID
from ucfrec_simulators.session_env import AnyEnv

PACKAGE: Final = "sardine"
EPSILONS: Final = (0.2, 0.5, 0.8, 1.0)
"""Shares of uniform items in the sessions of `mixture`, all equally likely."""


class SardineEnvironment(GymnasiumCatalog):
    """N sessions of a SARDINE environment of single items.

    Args:
        variant: `Static` or `BoredInf`.

    Raises:
        InputError: `sardine-rec` is not installed.
    """

    def __init__(self, variant: str, num_envs: int) -> None:
        try:
            __import__(PACKAGE)
        except ImportError as error:
            raise InputError(
                f"SARDINE cannot be imported ({error}); install it with pip install "
                "'ucfrec[sardine]'"
            ) from None
        super().__init__(f"{PACKAGE}/SingleItem-{variant}-v0", num_envs, _items)
        self.vectors: Float32Array = _sardine(self.envs[0]).item_embedd
        """(n_items, 10) weight of each topic in each item."""

    def favourites(self) -> IntArray:
        """(N,) the item that each user is most likely to click now."""
        tastes = np.stack([_sardine(env).cur_user_embedd for env in self.envs])
        return np.asarray(np.argmax(tastes @ self.vectors.T, axis=1))


def _sardine(env: gymnasium.Env[Any, Any]) -> Any:
    """SARDINE's own environment, of which no types are known."""
    return env.unwrapped


def _items(env: gymnasium.Env[Any, Any], n_items: int) -> pa.Table:
    """The item table: `item_id`, the vector `topics`, and `tags`, the topics that are not zero."""
    topics, ids = _sardine(env).item_embedd, pa.array(np.arange(n_items))
    tags = pa.array([np.flatnonzero(row) for row in topics])
    vectors = pa.array(list(topics.astype(np.float32)))
    return pa.table({ITEM_ID: ids, "topics": vectors, "tags": tags})


class GreedyOracle:
    """The short-term oracle, which knows the user's tastes, with uniform items in between.

    It shows the item that the user is most likely to click, and with probability ε any item; ε is
    drawn for each session. The propensity of item i is ε / n_items, plus 1 − ε if the oracle
    chooses i: that of the session's policy, which is a valid denominator for importance sampling
    because the draw of ε does not depend on what happens in the session.

    Args:
        epsilons: values of ε, all equally likely.

    Raises:
        InputError: `env` is not a `SardineEnvironment`.
    """

    def __init__(self, env: AnyEnv, seed: int, epsilons: Sequence[float] = (0.0,)) -> None:
        if not isinstance(env.unwrapped, SardineEnvironment):
            raise InputError(f"this behavior policy serves SARDINE, not {type(env).__name__}")
        self._environment, self._choices = env.unwrapped, np.asarray(epsilons)
        self._generator = np.random.default_rng([seed, 6])
        self._epsilon = np.zeros(env.num_envs)

    def begin(self, rows: IntArray) -> None:
        """Draw ε of the sessions that start."""
        self._epsilon[rows] = self._generator.choice(self._choices, size=len(rows))

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[IntArray, Float32Array]:
        """Draw items (N,); returns them and their propensities (N,)."""
        n_items, count = len(self._environment.vectors), len(self._epsilon)
        greedy = self._environment.favourites()
        uniform = self._generator.integers(n_items, size=count)
        chosen = np.where(self._generator.random(count) < self._epsilon, uniform, greedy)
        propensities = self._epsilon / n_items + (1 - self._epsilon) * (chosen == greedy)
        return chosen, propensities.astype(np.float32)

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Do nothing: tastes are read from the environment."""


def _simulator(variant: str, summary: str) -> Simulator:
    return Simulator(
        summary=f"SARDINE: 1,000 items, 100 steps, clicks; {summary} (extra: sardine)",
        make=lambda num_envs, folder: SardineEnvironment(variant, num_envs),
        behaviors={
            "random": Uniform,
            "mixture": partial(GreedyOracle, epsilons=EPSILONS),
            "oracle": GreedyOracle,
        },
        feedback="is_click",
    )


STATIC: Final = _simulator("Static", "tastes of a session stay as they are")
BORED_INF: Final = _simulator("BoredInf", "satiation, and clicks that change tastes")
