"""Tasks, their environments, and D4RL's normalised scores."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ucfrec.errors import InputError


@dataclass(frozen=True)
class Task:
    """A family of environments whose returns share one scale."""

    name: str
    pattern: str
    """What the names of its environments and datasets match, lower case, `_` and `-` left out."""
    sizes: tuple[int, int]
    """S and A in D4RL."""
    low: float
    """D4RL's reference return of a random policy: score 0."""
    high: float
    """D4RL's reference return of an expert: score 100."""
    d4rl_envs: Mapping[str, str]
    """Environments that D4RL's own datasets were made in, in their oldest gymnasium version, by
    what the dataset's name matches."""

    def score(self, returns: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Returns on the scale where a random policy has 0 and an expert 100."""
        return 100 * (np.asarray(returns, dtype=np.float64) - self.low) / (self.high - self.low)

    def d4rl_env(self, dataset: str) -> str | None:
        """The environment of a dataset of D4RL; None where its name does not tell."""
        plain = _plain(dataset)
        return next((env for name, env in self.d4rl_envs.items() if name in plain), None)


def _plain(name: str) -> str:
    return re.sub("[-_/ ]", "", name.lower())


D4RL_ANTMAZE = "d4rl/antmaze-{maze}-v2"
"""`ucfrec_control.worlds.antmaze` registers it."""
_MAZES = {
    # The files themselves are named otherwise (`Ant_maze_big-maze_…`) than their datasets.
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


def find_task(*names: str | None) -> Task | None:
    """The task that the first telling one of `names` (of environments, files, datasets) is of."""
    for name in names:
        for task in TASKS:
            if task.pattern in _plain(name or ""):
                return task
    return None


def require_task(*names: str | None) -> Task:
    """The same.

    Raises:
        InputError: no name tells.
    """
    task = find_task(*names)
    if task is None:
        known = ", ".join(task.name for task in TASKS)
        raise InputError(
            f"no reference returns are known for {' or '.join(filter(None, names)) or 'it'}; "
            f"scores are for {known}"
        )
    return task


# Most specific first: "medium" is part of the others, and a size of AntMaze's mazes.
_KINDS = ("diverse", "medium-replay", "medium-expert", "medium", "mixed", "expert", "random")


def find_kind(name: str) -> str:
    """How a dataset was collected (`medium`, `mixed`, …), told from its name; "" if it is not."""
    plain = name.lower().replace("_", "-")
    return next((kind for kind in _KINDS if kind in plain), "")


def dataset_name(source: Path | str) -> str:
    """Short name of a dataset from its file or identifier, as in `hopper_medium-zoo`."""
    text = str(source)
    return Path(text).stem if text.endswith((".hdf5", ".h5")) else text.rstrip("/")


def check_sizes(task: Task | None, sizes: Sequence[Any], where: str) -> None:
    """Raise InputError unless states and actions are of D4RL's sizes for `task`."""
    if task is not None and tuple(sizes) != task.sizes:
        raise InputError(
            f"{where}: observations and actions have sizes {tuple(sizes)}, those of {task.name} "
            f"are {task.sizes}; name the environment that the data is of with --env"
        )
