"""D4RL's AntMaze, rebuilt on that of gymnasium-robotics.

No version of gymnasium-robotics has the world of D4RL's datasets: there the maze is mirrored and
its origin is the center, a step lasts half as long, the motors are five times as strong, and start
and goal are drawn from all cells. What is changed here follows D4RL's public code
(https://github.com/Farama-Foundation/D4RL, d4rl/locomotion: maze_env.py, ant.py,
goal_reaching_env.py, assets/ant.xml); what MuJoCo itself changed since 2.0 stays.
"""

import xml.etree.ElementTree as ET
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium.envs.mujoco
import numpy as np
import numpy.typing as npt
from gymnasium_robotics.envs.maze import maps
from gymnasium_robotics.envs.maze.ant_maze_v5 import AntMazeEnv

FloatArray = npt.NDArray[np.float64]

_ANT = Path(gymnasium.envs.mujoco.__file__).parent / "assets" / "ant.xml"
_START = (1, 1)
_MAZES = {
    "umaze": (maps.U_MAZE, (3, 1)),
    "medium": (maps.MEDIUM_MAZE, (6, 6)),
    "large": (maps.LARGE_MAZE, (7, 9)),
}
"""Walls, and the cell (row, column) of the goal; the start is one for all."""
_GOAL_RADIUS = 0.5


class D4RLAntMaze(AntMazeEnv):
    """`antmaze-{umaze,medium,large}` of D4RL, version 2: the goal is drawn at every reset.

    The reward is 1 at the goal, where the episode ends, and else 0.
    """

    def __init__(self, maze: str, render_mode: str | None = None) -> None:
        """
        Args:
            maze: `umaze`, `medium` or `large`.
        """
        walls, self._goal_cell = _MAZES[maze]
        with TemporaryDirectory() as folder:
            super().__init__(
                render_mode=render_mode,
                # D4RL's y grows with the row, here it falls.
                maze_map=walls[::-1],
                reward_type="sparse",
                continuing_task=False,
                xml_file=_d4rl_ant(Path(folder)),
                include_cfrc_ext_in_observation=False,
            )
        # gymnasium-robotics passes 0 and takes no other value.
        self.ant_env._reset_noise_scale = 0.1
        self.metadata = {**AntMazeEnv.metadata, "render_fps": round(1 / self.ant_env.dt)}
        self.origin = self._center(_START)

    def _center(self, cell: tuple[int, int]) -> FloatArray:
        row, column = cell
        center: FloatArray = self.maze.cell_rowcol_to_xy(
            np.array([self.maze.map_length - 1 - row, column])
        )
        return center

    def generate_target_goal(self) -> FloatArray:
        """Beside the center of the goal's cell, on the side away from the start."""
        quarter = self.maze.maze_size_scaling / 4
        offset = self.np_random.uniform(0, quarter, 2) + self.np_random.uniform(0, quarter / 2, 2)
        goal: FloatArray = self._center(self._goal_cell) + offset
        return goal

    def generate_reset_pos(self) -> FloatArray:
        """The start; the ant's own noise moves it."""
        return self.origin.copy()

    def add_xy_position_noise(self, xy_pos: FloatArray) -> FloatArray:
        """Nothing: D4RL draws no such noise."""
        return xy_pos

    def compute_reward(self, achieved_goal: FloatArray, desired_goal: FloatArray, info: Any) -> Any:
        """1 at the goal, else 0."""
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return (distance <= _GOAL_RADIUS).astype(np.float64)

    def compute_terminated(
        self, achieved_goal: FloatArray, desired_goal: FloatArray, info: Any
    ) -> bool:
        """Whether the goal is reached."""
        return bool(self.compute_reward(achieved_goal, desired_goal, info))


def _d4rl_ant(folder: Path) -> str:
    """Gymnasium's ant with D4RL's clock, motors and contacts; the bodies are the same."""
    tree = ET.parse(_ANT)
    changes = {
        "option": {"timestep": "0.02"},
        "default/geom": {"solimp": ".8 .8 .01"},
        # D4RL has ±30 without a gear, and scales actions to it.
        "actuator/motor": {"gear": "30"},
    }
    for path, values in changes.items():
        for element in tree.findall(path):
            element.attrib.update(values)
    file = folder / "ant.xml"
    tree.write(file)
    return str(file)
