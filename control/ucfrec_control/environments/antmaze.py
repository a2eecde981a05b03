"""AntMaze environments (extra `antmaze`), with observations in the layout of D4RL's datasets."""

from collections.abc import Mapping
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from ucfrec.arrays import Float32Array
from ucfrec.errors import InputError
from ucfrec_control.environments.scores import D4RL_ANTMAZE, find_task

_STEPS = {"umaze": 700, "medium": 1000, "large": 1000}
_REBUILT = {D4RL_ANTMAZE.format(maze=maze): (maze, limit) for maze, limit in _STEPS.items()}

for _id, (_maze, _limit) in _REBUILT.items():
    gymnasium.register(
        _id,
        "ucfrec_control.environments.d4rl_antmaze:D4RLAntMaze",
        max_episode_steps=_limit,
        kwargs={"maze": _maze},
    )


def is_antmaze(env_id: str) -> bool:
    """Return whether `env_id` names an AntMaze, D4RL's or one of gymnasium-robotics."""
    task = find_task(env_id)
    return task is not None and task.name == "antmaze"


def is_rebuilt(env_id: str) -> bool:
    """Return whether `env_id` names a maze of `ucfrec_control.environments.d4rl_antmaze`."""
    return env_id in _REBUILT


def antmaze_settings(env_id: str) -> Mapping[str, Any]:
    """Register the environments of gymnasium-robotics; returns arguments of `gymnasium.make` with
    which an episode of an AntMaze returns 1 for success and 0 otherwise.

    Raises:
        InputError: gymnasium-robotics is not installed.
    """
    try:
        # The import prints a notice about environments that are not used here.
        with redirect_stderr(StringIO()):
            import gymnasium_robotics
    except ImportError:
        raise InputError(
            f"{env_id} needs gymnasium-robotics, which is not installed; install ucfrec[antmaze]"
        ) from None
    gymnasium.register_envs(gymnasium_robotics)
    return {} if is_rebuilt(env_id) else {"continuing_task": False, "reward_type": "sparse"}


class GoalObservations(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Flattens AntMaze's dictionary observations to the vectors (29,) of D4RL's datasets.

    A vector holds the position (x, y) and then the rest of the ant's state. It excludes the goal.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        space = env.observation_space
        assert isinstance(space, Dict)
        sizes = [space[name].shape or () for name in ("achieved_goal", "observation")]
        self.observation_space = Box(-np.inf, np.inf, (sum(size[0] for size in sizes),))
        self._origin = getattr(env.unwrapped, "origin", np.zeros(2))
        # gymnasium-robotics has finished with this temporary file but does not delete it.
        Path(getattr(env.unwrapped, "tmp_xml_file_path", "")).unlink(missing_ok=True)

    def observation(self, observation: Mapping[str, Any]) -> Float32Array:
        """Flatten `achieved_goal` (2,), the ant's position, and `observation` (O − 2,) to (O,); the
        position is relative to the environment's `origin`, the start, if it has one."""
        position = observation["achieved_goal"] - self._origin
        return np.concatenate([position, observation["observation"]]).astype(np.float32)
