"""D4RL's AntMaze, rebuilt on the AntMaze of gymnasium-robotics.

No version of gymnasium-robotics reproduces the environment of D4RL's datasets. In its version the
maze is mirrored, the origin is the center of the maze, a step lasts half as long, the motors are
five times as strong, and start and goal are drawn from all cells. This module changes these points
to match D4RL's public code
(https://github.com/Farama-Foundation/D4RL, d4rl/locomotion: maze_env.py, ant.py,
goal_reaching_env.py, assets/ant.xml). Changes in MuJoCo itself since version 2.0 are not undone.
"""

import xml.etree.ElementTree as ET
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import gymnasium.envs.mujoco
import numpy as np
from gymnasium_robotics.envs.maze import maps
from gymnasium_robotics.envs.maze.ant_maze_v5 import AntMazeEnv

from ucfrec.arrays import Float64Array
from ucfrec.files.atomic import scratch_folder

_ANT = Path(gymnasium.envs.mujoco.__file__).parent / "assets" / "ant.xml"
_START = (1, 1)
_MAZES = {
    "umaze": (maps.U_MAZE, (3, 1)),
    "medium": (maps.MEDIUM_MAZE, (6, 6)),
    "large": (maps.LARGE_MAZE, (7, 9)),
}
"""For each maze, its walls and the cell (row, column) of the goal. All mazes start in `_START`."""
_GOAL_RADIUS = 0.5


class D4RLAntMaze(AntMazeEnv):
    """`antmaze-{umaze,medium,large}` of D4RL, version 2, in which every reset draws the goal.

    The reward is 1 at the goal, where the episode ends, and 0 everywhere else.
    """

    def __init__(self, maze: str, render_mode: str | None = None) -> None:
        """`maze` is `umaze`, `medium` or `large`."""
        walls, self._goal_cell = _MAZES[maze]
        with scratch_folder(Path(gettempdir()), "maze") as folder:
            super().__init__(
                render_mode=render_mode,
                # y grows with the row in D4RL but falls with it in gymnasium-robotics.
                maze_map=walls[::-1],
                reward_type="sparse",
                continuing_task=False,
                xml_file=_d4rl_ant(folder),
                include_cfrc_ext_in_observation=False,
            )
        # gymnasium-robotics always passes 0 to the ant and has no argument to change it.
        self.ant_env._reset_noise_scale = 0.1
        self.metadata = {**AntMazeEnv.metadata, "render_fps": round(1 / self.ant_env.dt)}
        self.origin = self._center(_START)

    def _center(self, cell: tuple[int, int]) -> Float64Array:
        row, column = cell
        cell_from_below = np.array([self.maze.map_length - 1 - row, column])
        return np.asarray(self.maze.cell_rowcol_to_xy(cell_from_below))

    def generate_target_goal(self) -> Float64Array:
        """Draw the goal (2,): each coordinate is that of its cell's center or above, by less than
        3/8 of the cell's side."""
        quarter = self.maze.maze_size_scaling / 4
        offset = self.np_random.uniform(0, quarter, 2) + self.np_random.uniform(0, quarter / 2, 2)
        return np.asarray(self._center(self._goal_cell) + offset)

    def generate_reset_pos(self) -> Float64Array:
        """Return the start position (2,), without noise; the ant adds its own when it is reset."""
        return self.origin.copy()

    def add_xy_position_noise(self, xy_pos: Float64Array) -> Float64Array:
        """Return the position (2,) unchanged, because D4RL adds no noise here."""
        return xy_pos

    def compute_reward(
        self, achieved_goal: Float64Array, desired_goal: Float64Array, info: Any
    ) -> Any:
        """The sparse reward (...) of positions (..., 2): 1 within `_GOAL_RADIUS` of the goal."""
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return (distance <= _GOAL_RADIUS).astype(np.float64)

    def compute_terminated(
        self, achieved_goal: Float64Array, desired_goal: Float64Array, info: Any
    ) -> bool:
        """Return whether the ant at `achieved_goal` (2,) has reached `desired_goal` (2,)."""
        return bool(self.compute_reward(achieved_goal, desired_goal, info))


def _d4rl_ant(folder: Path) -> str:
    """Write Gymnasium's ant with D4RL's time step, motors and contacts to a file in `folder`.

    The bodies are the same in both.
    """
    tree = ET.parse(_ANT)
    changes = {
        "option": {"timestep": "0.02"},
        "default/geom": {"solimp": ".8 .8 .01"},
        # In D4RL the motors take ±30 without a gear, and actions are scaled to that range.
        "actuator/motor": {"gear": "30"},
    }
    for path, values in changes.items():
        for element in tree.findall(path):
            element.attrib.update(values)
    file = folder / "ant.xml"
    tree.write(file)
    return str(file)
