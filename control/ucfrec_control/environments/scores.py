"""Tasks, their environments, and D4RL's normalised scores."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ucfrec.arrays import Float64Array
from ucfrec.errors import InputError


@dataclass(frozen=True)
class Task:
    """A family of environments whose returns share one scale."""

    name: str
    pattern: str
    """Text contained in the names of its environments and datasets, once these are in lower case
    and without `-`, `_`, `/` and spaces."""
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
        plain = _plain(dataset)
        return next((env for name, env in self.d4rl_envs.items() if name in plain), None)


def normalise(returns: npt.ArrayLike, reference: tuple[float, float]) -> Float64Array:
    """Scores of returns of any shape: 0 for the lower return of the reference, 100 for the higher.

    Raises:
        InputError: the second return of the reference is not above the first.
    """
    low, high = reference
    if not low < high:
        raise InputError(f"--reference {low:g} {high:g}: the second return must be the higher one")
    return 100 * (np.asarray(returns, dtype=np.float64) - low) / (high - low)


def _plain(name: str) -> str:
    return re.sub("[-_/ ]", "", name.lower())


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
    Task("antmaze", "antmaze", (29, 8), 0.0, 1.0, _ANTMAZES),
)


def find_task(name: str | None, second_name: str | None = None) -> Task | None:
    """The task of a name of an environment, file or dataset, else of another name; None if neither
    belongs to one."""
    plain = [_plain(text or "") for text in (name, second_name)]
    return next((task for text in plain for task in TASKS if task.pattern in text), None)


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
