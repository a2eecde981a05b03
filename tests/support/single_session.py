"""An environment of one session, as Gymnasium's own checks take it."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import VectorEnv

from ucfrec.arrays import Array, Float32Array


class SingleSession(gymnasium.Env[Float32Array, Array]):
    """A plain Gymnasium environment of a vector environment with one session."""

    def __init__(self, environment: VectorEnv[Float32Array, Array, Array]) -> None:
        self._environment = environment
        self.observation_space = environment.single_observation_space
        self.action_space = environment.single_action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Float32Array, Any]:
        """Start a session; returns the observation (O,) and info."""
        super().reset(seed=seed, options=options)
        observations, infos = self._environment.reset(seed=seed, options=options)
        return observations[0], _first(infos)

    def step(self, action: Array) -> tuple[Float32Array, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take one action; returns observation (O,), reward, terminated, truncated and info."""
        seen, rewards, ends, cuts, infos = self._environment.step(np.asarray(action)[None])
        ended = bool(ends[0] | cuts[0])
        observation = infos["final_obs"][0] if ended else seen[0]
        info = _first(infos["final_info"] if ended else infos)
        return observation, float(rewards[0]), bool(ends[0]), bool(cuts[0]), info


def _first(infos: dict[str, Any]) -> dict[str, Any]:
    return {key: value[0] for key, value in infos.items() if not key.startswith("_")}


def check_environment(environment: VectorEnv[Float32Array, Array, Array]) -> None:
    """Gymnasium's own checks of a vector environment with one session."""
    check_env(SingleSession(environment), skip_render_check=True)
