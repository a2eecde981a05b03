"""Uniformly random actions, the built-in policy `random` of every environment."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.schema import FORBIDDEN


class Memoryless:
    """An actor whose choice depends on the current observation only."""

    def begin(self, rows: IntArray) -> None:
        """Do nothing: there is no state to reset."""

    def observe(self, actions: Array, rewards: Float32Array) -> None:
        """Do nothing: there is no state to update."""


class Uniform(Memoryless):
    """Uniformly random actions: vectors in a box, or items of a catalogue with their propensity.

    Raises:
        InputError: the actions are vectors without finite bounds.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], seed: int) -> None:
        self._space = env.single_action_space
        if isinstance(self._space, spaces.Box) and not self._space.is_bounded():
            raise InputError(
                "no vectors can be drawn uniformly, because the environment's actions have no "
                "finite bounds; collect its logs with another policy, or bound its action space"
            )
        self._generator = np.random.default_rng([seed, 1])
        self._forbidden: IntArray | None = None

    def inform(self, info: Mapping[str, Any]) -> None:
        """Read the (N, L) forbidden items of each session from `info`, if the environment masks
        items."""
        self._forbidden = info.get(FORBIDDEN)

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[Array, Float32Array | None]:
        """Draw actions: (N, A) without propensities, or items (N,) with propensities (N,)."""
        count = len(observations)
        if isinstance(self._space, spaces.Discrete):
            n_items = int(self._space.n)
            if self._forbidden is not None:
                return self._draw_allowed(self._forbidden, n_items)
            chosen = self._generator.integers(n_items, size=count)
            return chosen, np.full(count, 1.0 / n_items, dtype=np.float32)
        assert isinstance(self._space, spaces.Box)
        low, high = self._space.low, self._space.high
        vectors = self._generator.uniform(low, high, size=(count, *low.shape))
        return vectors.astype(np.float32), None

    def _draw_allowed(self, forbidden: IntArray, n_items: int) -> tuple[IntArray, Float32Array]:
        """Draw uniformly among the allowed items; `forbidden` (N, L) is padded with −1.

        A rank among the allowed items is drawn, then raised by one per forbidden item up to it.
        """
        n_allowed = n_items - (forbidden >= 0).sum(axis=1)
        chosen = self._generator.integers(n_allowed)
        for item in np.sort(np.where(forbidden < 0, n_items, forbidden), axis=1).T:
            chosen += chosen >= item
        return chosen, (1.0 / n_allowed).astype(np.float32)
