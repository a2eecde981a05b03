"""Environments to judge in: vectorised, of the version that the data was made in."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv

from ucfrec.errors import InputError
from ucfrec_control.worlds.antmaze import GoalObservations, antmaze_settings, is_antmaze, is_rebuilt

SIDE_BY_SIDE = 50
"""Most episodes played at once; one forward pass serves them all."""


Wrap = Callable[[gymnasium.Env[Any, Any]], gymnasium.Wrapper[Any, Any, Any, Any]]


def make_env(
    env_id: str,
    count: int,
    appended: Sequence[float] = (),
    unseen: Sequence[int] = (),
    settings: Mapping[str, Any] | None = None,
    wrappers: Sequence[Wrap] = (),
) -> VectorEnv[Any, Any, Any]:
    """`count` environments in one process that reset within the step.

    In one process because MuJoCo's steps cost less than talking to others (measured). AntMaze shows
    D4RL's vectors and returns 1 for success and else 0.

    Args:
        appended: constants after every observation, where a policy was trained with distractors.
        unseen: dimensions of that observation which are left out.
        settings: arguments of the environment.
        wrappers: around each of them.

    Raises:
        InputError: the environment is not registered or cannot be started here.
    """
    settings, wrappers = dict(settings or {}), list(wrappers)
    if is_antmaze(env_id):
        settings |= antmaze_settings(env_id)
        wrappers = [GoalObservations, *wrappers]
    if len(appended):
        wrappers.append(partial(AppendedConstants, constants=appended))
    if len(unseen):
        wrappers.append(partial(WithoutDimensions, unseen=unseen))
    try:
        with warnings.catch_warnings():
            # D4RL's data is of v4: the version is old on purpose.
            warnings.filterwarnings("ignore", message=".*is out of date")
            return gymnasium.make_vec(
                env_id,
                count,
                vectorization_mode="sync",
                vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
                wrappers=wrappers,
                **settings,
            )
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"the environment {env_id} cannot be made ({reason}); install ucfrec[control], or name "
            "another with --env"
        ) from None


class AppendedConstants(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Appends the same numbers to every observation, whatever happens (Appendix G.4)."""

    def __init__(self, env: gymnasium.Env[Any, Any], constants: Sequence[float]) -> None:
        super().__init__(env)
        self._constants = np.asarray(constants, dtype=np.float64)
        space = env.observation_space
        assert isinstance(space, Box)
        low, high = (np.append(bound, constants) for bound in (space.low, space.high))
        self.observation_space = Box(low, high, dtype=np.float64)

    def observation(self, observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(O,) to (O + constants,)."""
        return np.append(observation, self._constants)


class WithoutDimensions(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Leaves some numbers of every observation out."""

    def __init__(self, env: gymnasium.Env[Any, Any], unseen: Sequence[int]) -> None:
        super().__init__(env)
        space = env.observation_space
        assert isinstance(space, Box)
        self._kept = np.setdiff1d(np.arange(len(space.low)), unseen)
        self.observation_space = Box(
            space.low[self._kept], space.high[self._kept], dtype=np.float64
        )

    def observation(self, observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(O,) to (O − unseen,)."""
        return observation[self._kept]


def mismatches(dataset: Mapping[str, Any], env_id: str) -> list[str]:
    """What sets the environment here apart from the one that `dataset` was made in, in words.

    Args:
        dataset: `source` of a control store.
    """
    found = []
    if dataset["env_id"] not in (None, env_id):
        found.append(f"the data is of {dataset['env_id']}, it is judged in {env_id}")
    if is_rebuilt(env_id):
        found.append(
            f"{env_id} is rebuilt from D4RL's code on MuJoCo {version('mujoco')}; nobody has "
            "replayed D4RL's trajectories in it"
        )
    for package in ("gymnasium", "mujoco", "gymnasium-robotics"):
        made_with = dataset["versions"].get(package)
        try:
            here = version(package)
        except PackageNotFoundError:
            continue
        if made_with not in (None, here):
            found.append(f"the data was made with {package} {made_with}, here is {here}")
    return found
