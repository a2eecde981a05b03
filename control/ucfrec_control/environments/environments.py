"""Vectorised environments for evaluation, and warnings where they differ from the data's.

AntMaze (extra `antmaze`) has observations in the layout of D4RL's datasets.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import TimeLimit

from ucfrec.arrays import Array, Float32Array
from ucfrec.errors import InputError
from ucfrec_control.environments.scores import D4RL_ANTMAZE, find_task

SIDE_BY_SIDE = 50
"""Largest number of episodes rolled out at once; the policy chooses all their actions together."""
_MOST_FRAMES = 1000
"""Largest number of simulated frames a step, which data of others states; MuJoCo's environments:
5."""
_LONGEST = 100_000
"""Largest number of steps of an episode."""

AnyEnv = VectorEnv[Any, Any, Any]
Wrap = Callable[[gymnasium.Env[Any, Any]], gymnasium.Wrapper[Any, Any, Any, Any]]
_STEPS = {"umaze": 700, "medium": 1000, "large": 1000}
_REBUILT = {D4RL_ANTMAZE.format(maze=maze): (maze, limit) for maze, limit in _STEPS.items()}

for _id, (_maze, _limit) in _REBUILT.items():
    gymnasium.register(
        _id,
        "ucfrec_control.environments.d4rl_antmaze:D4RLAntMaze",
        max_episode_steps=_limit,
        kwargs={"maze": _maze},
    )


def make_env(
    env_id: str,
    count: int,
    appended: Sequence[float] = (),
    settings: Mapping[str, Any] | None = None,
    wrappers: Sequence[Wrap] = (),
) -> AnyEnv:
    """Make `count` copies of an environment that reset in the step that ends an episode.

    They share one process because measurements showed that a MuJoCo step costs less than
    communication between processes. AntMaze gets D4RL's observation vectors, and its episodes
    return 1 for success and 0 otherwise. InputError if the environment is not registered or cannot
    be made.

    Args:
        appended: constants that stand in for distractors at the end of every observation.
        wrappers: wrappers around each environment, the innermost first.
    """
    settings, wrappers = dict(settings or {}), list(wrappers)
    skip = settings.get("frame_skip", 1)
    if type(skip) is not int or not 0 < skip <= _MOST_FRAMES:
        raise InputError(
            f"the environment {env_id} cannot be made with frame_skip {skip!r:.40}; it is a whole "
            f"number from 1 to {_MOST_FRAMES}"
        )
    if is_antmaze(env_id):
        settings |= antmaze_settings(env_id)
        wrappers = [GoalObservations, *wrappers]
    if len(appended):
        wrappers.append(partial(AppendedConstants, constants=appended))
    wrappers.append(partial(_Ending, max_episode_steps=_LONGEST))
    try:
        with warnings.catch_warnings():
            # D4RL's data needs v4, so the old version is intended.
            warnings.filterwarnings("ignore", message=".*is out of date")
            return gymnasium.make_vec(
                env_id,
                count,
                vectorization_mode="sync",
                vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
                wrappers=wrappers,
                **settings,
            )
    except (gymnasium.error.Error, ImportError, TypeError, ValueError, OSError) as error:
        # The settings that data states may be anything; MuJoCo raises ValueError over its files.
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"the environment {env_id} cannot be made ({reason}); install ucfrec[control], or name "
            "another with --env, your own as MODULE:NAME"
        ) from None


def environment_of_data(dataset: Mapping[str, Any]) -> str:
    """The environment that a dataset names, of which `dataset` is the `source` of its store.
    InputError if it names none, or one with a Python module, which Gymnasium would import: data
    does not choose what code runs."""
    name, env_id = dataset["dataset"], dataset["env_id"]
    if env_id is None:
        raise InputError(
            f"the data of {name} does not name its environment; give it with --env, or prepare the "
            "data with it"
        )
    module, separator, _ = str(env_id).partition(":")
    if separator:
        raise InputError(
            f"the data of {name} names the environment {env_id}, for which the Python module "
            f"{module} would be run; name the environment with --env"
        )
    return str(env_id)


def is_of_data(env_id: str, dataset: Mapping[str, Any]) -> bool:
    """Return whether `env_id` is the environment that a dataset names, in whichever module."""
    return env_id.rpartition(":")[2] == str(dataset["env_id"]).rpartition(":")[2]


class AppendedConstants(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Appends constants to every observation (Appendix G.4)."""

    def __init__(self, env: gymnasium.Env[Any, Any], constants: Sequence[float]) -> None:
        super().__init__(env)
        self._constants = np.asarray(constants, dtype=np.float64)
        space = env.observation_space
        assert isinstance(space, Box)
        low, high = (np.append(bound, constants) for bound in (space.low, space.high))
        self.observation_space = Box(low, high, dtype=np.float64)

    def observation(self, observation: Array) -> Array:
        """Return the observation (O,) with the constants at its end, (O + number of constants,)."""
        return np.append(observation, self._constants)


def is_antmaze(env_id: str) -> bool:
    """Return whether `env_id` names an AntMaze, D4RL's or one of gymnasium-robotics."""
    task = find_task(env_id)
    return task is not None and task.name == "antmaze"


def antmaze_settings(env_id: str) -> Mapping[str, Any]:
    """Register the environments of gymnasium-robotics; returns arguments of `gymnasium.make` with
    which an episode of an AntMaze returns 1 for success and 0 otherwise. InputError if
    gymnasium-robotics is not installed."""
    try:
        # The import prints a notice about environments that are not used here.
        with redirect_stderr(StringIO()):
            import gymnasium_robotics
    except ImportError:
        raise InputError(
            f"{env_id} needs gymnasium-robotics, which is not installed; install ucfrec[antmaze]"
        ) from None
    gymnasium.register_envs(gymnasium_robotics)
    return {} if env_id in _REBUILT else {"continuing_task": False, "reward_type": "sparse"}


class _Ending(TimeLimit):
    """Raises InputError in an episode of `max_episode_steps`, rather than cutting it."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        done = super().step(action)
        if (self._elapsed_steps or 0) >= _LONGEST:
            raise InputError(
                f"an episode of {getattr(self.unwrapped.spec, 'id', self)} has not ended after "
                f"{_LONGEST:,} steps; register the environment with max_episode_steps"
            )
        return done


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


def mismatches(dataset: Mapping[str, Any], env_id: str) -> list[str]:
    """How the evaluation's environment differs from the one that the data was made in."""
    warnings_ = []
    if dataset["env_id"] is not None and not is_of_data(env_id, dataset):
        warnings_.append(f"the data is of {dataset['env_id']}, the evaluation is in {env_id}")
    if env_id in _REBUILT:
        warnings_.append(
            f"{env_id} is rebuilt from D4RL's code on MuJoCo {version('mujoco')}; it was not "
            "verified by replaying D4RL's trajectories"
        )
    for package in ("gymnasium", "mujoco", "gymnasium-robotics"):
        made_with = dataset["versions"].get(package)
        with suppress(PackageNotFoundError):
            if made_with not in (None, installed := version(package)):
                warnings_.append(
                    f"the data was made with {package} {made_with}, {installed} is installed"
                )
    return warnings_
