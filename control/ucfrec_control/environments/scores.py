"""Tasks, their environments, and D4RL's normalised scores."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ucfrec.arrays import Float64Array
from ucfrec.errors import InputError


@dataclass(frozen=True)
class Task:
    """A family of environments whose returns share one scale."""

    name: str
    pattern: str
    """Regular expression, in lower case, of the name that its environments and datasets share."""
    sizes: tuple[int, int]
    """Number of state dimensions and of action dimensions in D4RL's datasets, (S, A)."""
    low: float
    """Return of D4RL's random reference policy; its score is 0."""
    high: float
    """Return of D4RL's expert reference policy; its score is 100."""
    d4rl_envs: Mapping[str, str]
    """Gymnasium environments that stand for those of D4RL's own datasets, in the oldest version
    available. A key is text that the dataset's name contains (`""` matches every name)."""

    def score(self, returns: npt.ArrayLike) -> Float64Array:
        """D4RL's normalised scores of undiscounted returns of any shape: 0 for the random reference
        policy, 100 for the expert."""
        return normalise(returns, (self.low, self.high))

    def d4rl_env(self, dataset: str) -> str | None:
        """Gymnasium's environment of a D4RL dataset of this name, or None if there is none."""
        plain = re.sub("[-_/]", "", dataset.lower())
        return next((env for name, env in self.d4rl_envs.items() if name in plain), None)


def normalise(returns: npt.ArrayLike, reference: tuple[float, float]) -> Float64Array:
    """Scores of returns of any shape: 0 for the lower return of the reference, 100 for the higher.

    Raises:
        InputError: the second return of the reference is not above the first, or one is infinite.
    """
    low, high = reference
    if not -math.inf < low < high < math.inf:
        raise InputError(f"--reference {low:g} {high:g}: give two numbers, the higher one second")
    return 100 * (np.asarray(returns, dtype=np.float64) - low) / (high - low)


D4RL_ANTMAZE = "d4rl/antmaze-{maze}-v2"
"""Identifier of a rebuilt AntMaze; `ucfrec_control.environments.environments` registers it."""
_MAZES = {
    # D4RL's files are named differently (`Ant_maze_big-maze_…`) from the datasets they hold.
    **{"umaze": "umaze", "medium": "medium", "bigmaze": "medium"},
    **{"large": "large", "hardestmaze": "large"},
}
_ANTMAZES = {name: D4RL_ANTMAZE.format(maze=maze) for name, maze in _MAZES.items()}

# Source: d4rl/infos.py (REF_MIN_SCORE, REF_MAX_SCORE).
TASKS = (
    Task("hopper", "hopper", (11, 3), -20.272305, 3234.3, {"": "Hopper-v4"}),
    Task("halfcheetah", "halfcheetah", (17, 6), -280.178953, 12135.0, {"": "HalfCheetah-v4"}),
    Task("walker2d", "walker2d", (17, 6), 1.629008, 4592.3, {"": "Walker2d-v4"}),
    Task("antmaze", "ant_?maze", (29, 8), 0.0, 1.0, _ANTMAZES),
)

_DATA: Final = (
    "random|medium|mixed|expert|full|simple|((u|big|hardest)-?maze|medium|open|large)(dense)?"
)
"""What may follow a task in a name of D4RL, Minari or Gymnasium, apart from a version."""
_NAME: Final = rf"((d4rl|mujoco)/|gymnasium_robotics:)?%s([-_/](v\d+|({_DATA})([-_/].*)?))?"


def find_task(name: str) -> Task | None:
    """The task of an environment, file or dataset; None unless its name is one of D4RL, Minari or
    Gymnasium, such as `Hopper-v4` and `hopper_medium-zoo`: robots of similar names are others."""
    plain = name.lower()
    return next((task for task in TASKS if re.fullmatch(_NAME % task.pattern, plain)), None)


# The first match counts. "medium" comes after the longer names that contain it, and after
# "diverse" because it is also the size of an AntMaze.
_KINDS = ("diverse", "medium-replay", "medium-expert", "medium", "mixed", "expert", "random")


def find_kind(name: str) -> str:
    """How a dataset was collected, such as `medium` or `mixed`; "" if its name does not say."""
    plain = name.lower().replace("_", "-")
    return next((kind for kind in _KINDS if kind in plain), "")


def dataset_name(source: Path | str) -> str:
    """The name of an HDF5 file without folder and ending, such as `hopper_medium-zoo`; of another
    dataset its identifier without trailing slashes."""
    text = str(source)
    return Path(text).stem if text.endswith((".hdf5", ".h5")) else text.rstrip("/")


def check_sizes(task: Task | None, sizes: Sequence[Any], where: str) -> None:
    """Check the numbers (S, A) of dimensions of states and actions of the data `where`.

    Raises:
        InputError: they differ from those of D4RL for `task`.
    """
    if task is not None and tuple(sizes) != task.sizes:
        raise InputError(
            f"{where}: observations and actions have sizes {tuple(sizes)}, those of {task.name} "
            f"are {task.sizes}; name the environment that the data is of with --env"
        )
