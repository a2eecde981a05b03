"""AntMaze (extra `antmaze`): which environment, and its goal observations as D4RL's vectors."""

from collections.abc import Mapping
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Dict

from ucfrec.errors import InputError
from ucfrec_control.worlds.scores import D4RL_ANTMAZE, find_task

_STEPS = {"umaze": 700, "medium": 1000, "large": 1000}
_REBUILT = {D4RL_ANTMAZE.format(maze=maze): (maze, limit) for maze, limit in _STEPS.items()}

for _id, (_maze, _limit) in _REBUILT.items():
    gymnasium.register(
        _id,
        "ucfrec_control.worlds.d4rl_antmaze:D4RLAntMaze",
        max_episode_steps=_limit,
        kwargs={"maze": _maze},
    )


def is_antmaze(env_id: str) -> bool:
    """Whether `env_id` is an AntMaze, of D4RL or of gymnasium-robotics."""
    task = find_task(env_id)
    return task is not None and task.name == "antmaze"


def is_rebuilt(env_id: str) -> bool:
    """Whether `env_id` is D4RL's AntMaze as `ucfrec_control.worlds.d4rl_antmaze` rebuilds it."""
    return env_id in _REBUILT


def antmaze_settings(env_id: str) -> Mapping[str, Any]:
    """Arguments with which an episode of AntMaze returns 1 for success and else 0.

    Raises:
        InputError: gymnasium-robotics is not installed.
    """
    try:
        # On import it prints a notice on other environments.
        with redirect_stderr(StringIO()):
            import gymnasium_robotics
    except ImportError:
        raise InputError(
            f"{env_id} needs gymnasium-robotics, which is not installed; install "
            "ucfrec[control,antmaze]"
        ) from None
    gymnasium.register_envs(gymnasium_robotics)
    return {} if is_rebuilt(env_id) else {"continuing_task": False, "reward_type": "sparse"}


class GoalObservations(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Position, then the rest, without the goal: the vector that D4RL's datasets have (29,)."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        shown = env.observation_space
        assert isinstance(shown, Dict)
        sizes = [shown[name].shape or () for name in ("achieved_goal", "observation")]
        self.observation_space = Box(-np.inf, np.inf, (sum(size[0] for size in sizes),))
        self._origin = getattr(env.unwrapped, "origin", np.zeros(2))
        # gymnasium-robotics has read this file and leaves it behind.
        Path(getattr(env.unwrapped, "tmp_xml_file_path", "")).unlink(missing_ok=True)

    def observation(self, observation: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """Goal observation to (O,)."""
        position = observation["achieved_goal"] - self._origin
        return np.concatenate([position, observation["observation"]]).astype(np.float32)
