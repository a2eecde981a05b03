"""Rollouts and metrics against plain bookkeeping; uniform actions, allowed and evenly."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from ucfrec.acting.rollout import Episodes, Step, Uniform, rollout
from ucfrec.arrays import BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.evaluation.evaluate import session_metrics
from ucfrec.results.statistics import bootstrap_interval
from ucfrec.schema import FORBIDDEN


class Countdown(gym.Env[Float32Array, int]):
    """Episode e of environment i lasts as long as its seeded draw; the reward is the step."""

    observation_space = gym.spaces.Box(0, 1000, (2,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.length = int(self.np_random.integers(1, 9))
        self.step_number = 0
        return self._observation(), {}

    def step(self, action: int) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        self.step_number += 1
        done = self.step_number >= self.length
        return self._observation(), float(self.step_number), done, False, {}

    def _observation(self) -> Float32Array:
        return np.array([self.length, self.step_number], dtype=np.float32)


class Recorder:
    """An actor that notes what it receives."""

    def __init__(self, n: int) -> None:
        self.steps = np.zeros(n, dtype=np.int64)

    def begin(self, rows: IntArray) -> None:
        self.steps[rows] = 0

    def act(self, observations: Float32Array, live: BoolArray) -> tuple[IntArray, None]:
        np.testing.assert_array_equal(observations[:, 1], self.steps)
        return np.zeros(len(observations), dtype=np.int64), None

    def observe(self, actions: IntArray, rewards: Float32Array) -> None:
        self.steps += 1


def environments(n: int) -> SyncVectorEnv:
    return SyncVectorEnv([Countdown] * n, autoreset_mode=AutoresetMode.SAME_STEP)


@pytest.mark.parametrize(("n", "episodes"), [(4, 4), (3, 11), (5, 2)])
def test_every_episode_is_played_once_by_its_environment(n: int, episodes: int) -> None:
    seen: list[Step] = []
    played = rollout(environments(n), Recorder(n), episodes, seed=3, on_step=seen.append)
    expected = {}
    for i in range(n):
        env = Countdown()
        env.reset(seed=3 + i)
        for episode in range(i, episodes, n):
            expected[episode] = env.length
            env.reset()
    lengths = np.array([expected[episode] for episode in range(episodes)])
    np.testing.assert_array_equal(played.lengths, lengths)
    np.testing.assert_array_equal(played.returns, lengths * (lengths + 1) / 2)
    assert sum(len(step.rows) for step in seen) == lengths.sum()
    assert all(np.array_equal(step.episodes % n, step.rows) for step in seen)


def test_an_environment_that_resets_late_is_refused() -> None:
    late = SyncVectorEnv([Countdown], autoreset_mode=AutoresetMode.NEXT_STEP)
    with pytest.raises(InputError, match="SAME_STEP"):
        rollout(late, Recorder(1), 1, seed=0)


def test_pooled_and_episode_averages_differ_as_defined() -> None:
    metrics = session_metrics(Episodes(np.array([10.0, 3.0]), np.array([10, 1])))
    assert metrics["R_cum"] == 6.5
    assert metrics["R_avg_pooled"] == pytest.approx(13 / 11)
    assert metrics["R_avg_episode"] == 2.0


def test_bootstrap_interval_is_the_normal_one_for_many_episodes() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, size=1000)
    low, high = bootstrap_interval(values, seed=1)
    error = 1.96 * values.std() / np.sqrt(len(values))
    assert low == pytest.approx(values.mean() - error, abs=0.02)
    assert high == pytest.approx(values.mean() + error, abs=0.02)
    assert bootstrap_interval(values, seed=1) == (low, high)


# Uniform actions.


def uniform(actions: gym.spaces.Space[Any]) -> Uniform:
    return Uniform(SimpleNamespace(single_action_space=actions), 0)  # type: ignore[arg-type]


LIVE = np.ones(3000, dtype=np.bool_)
NOTHING = np.zeros((3000, 0), dtype=np.float32)


def test_forbidden_items_are_never_drawn_and_the_others_evenly() -> None:
    actor = uniform(gym.spaces.Discrete(6))
    actor.inform({FORBIDDEN: np.tile([4, -1, 0], (3000, 1))})
    items, propensities = actor.act(NOTHING, LIVE)
    counts = np.bincount(items, minlength=6)
    assert counts[[0, 4]].sum() == 0
    np.testing.assert_allclose(counts[[1, 2, 3, 5]], 750, atol=110)
    np.testing.assert_allclose(propensities, 1 / 4)


def test_vectors_fill_their_box() -> None:
    low, high = np.array([-1.0, 5.0], dtype=np.float32), np.array([1.0, 7.0], dtype=np.float32)
    vectors, propensities = uniform(gym.spaces.Box(low, high)).act(NOTHING, LIVE)
    assert propensities is None
    np.testing.assert_allclose(vectors.min(0), low, atol=0.01)
    np.testing.assert_allclose(vectors.max(0), high, atol=0.01)
    with pytest.raises(InputError, match="no finite bounds"):
        uniform(gym.spaces.Box(-np.inf, np.inf, (2,)))
