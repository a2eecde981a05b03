"""Environments to judge in: vectorised, of the version that the data was made in."""

import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv

from ucfrec.errors import InputError

SIDE_BY_SIDE = 50
"""Most episodes played at once; one forward pass serves them all."""


def make_env(env_id: str, count: int, appended: Sequence[float] = ()) -> VectorEnv[Any, Any, Any]:
    """`count` environments in one process that reset within the step.

    In one process because MuJoCo's steps cost less than talking to others (measured).

    Args:
        appended: constants after every observation, where a policy was trained with distractors.

    Raises:
        InputError: the environment is not registered or cannot be started here.
    """
    wrappers = [partial(AppendedConstants, constants=appended)] if len(appended) else []
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
            )
    except (gymnasium.error.Error, ImportError) as error:
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


def mismatches(dataset: Mapping[str, Any], env_id: str) -> list[str]:
    """What sets the environment here apart from the one that `dataset` was made in, in words.

    Args:
        dataset: `source` of a control store.
    """
    found = []
    if dataset["env_id"] not in (None, env_id):
        found.append(f"the data is of {dataset['env_id']}, it is judged in {env_id}")
    for package in ("gymnasium", "mujoco"):
        made_with = dataset["versions"].get(package)
        try:
            here = version(package)
        except PackageNotFoundError:
            continue
        if made_with not in (None, here):
            found.append(f"the data was made with {package} {made_with}, here is {here}")
    return found
