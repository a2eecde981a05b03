"""Uniform actions: which are allowed, how probable, and where none can be drawn."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from ucfrec.acting.uniform import Uniform
from ucfrec.errors import InputError
from ucfrec.schema import FORBIDDEN


class Bare(gymnasium.Env[np.ndarray, np.ndarray]):
    """Nothing but an action space."""

    observation_space = spaces.Box(-1, 1, (1,))

    def __init__(self, actions: spaces.Space[np.ndarray]) -> None:
        self.action_space = actions


def uniform(actions: spaces.Space[np.ndarray], seed: int = 0) -> Uniform:
    return Uniform(SyncVectorEnv([lambda: Bare(actions)]), seed)


LIVE = np.ones(3000, dtype=np.bool_)
NOTHING = np.zeros((3000, 0), dtype=np.float32)


def test_forbidden_items_are_never_drawn_and_the_others_evenly() -> None:
    actor = uniform(spaces.Discrete(6))
    actor.inform({FORBIDDEN: np.tile([4, -1, 0], (3000, 1))})
    items, propensities = actor.act(NOTHING, LIVE)
    counts = np.bincount(items, minlength=6)
    assert counts[[0, 4]].sum() == 0
    np.testing.assert_allclose(counts[[1, 2, 3, 5]], 750, atol=110)
    np.testing.assert_allclose(propensities, 1 / 4)


def test_vectors_fill_their_box() -> None:
    low, high = np.array([-1.0, 5.0], dtype=np.float32), np.array([1.0, 7.0], dtype=np.float32)
    vectors, propensities = uniform(spaces.Box(low, high)).act(NOTHING, LIVE)
    assert propensities is None
    np.testing.assert_allclose(vectors.min(0), low, atol=0.01)
    np.testing.assert_allclose(vectors.max(0), high, atol=0.01)


def test_a_box_without_bounds_has_no_uniform_vectors() -> None:
    with pytest.raises(InputError, match="no finite bounds"):
        uniform(spaces.Box(-np.inf, np.inf, (2,)))
