"""VirtualTaobao with the exit rule of CIRS (Gao et al., TOIS 2023): repeated actions end it."""

from pathlib import Path
from typing import Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.evaluation.simulator import Simulator
from ucfrec_simulators.session_env import data_folder
from ucfrec_simulators.taobao import ddpg
from ucfrec_simulators.taobao.environment import ACTION_DIM, MAX_CLICKS, PAGE_INDICES, USER_BITS
from ucfrec_simulators.taobao.virtual import VirtualTaobao, mixture

WINDOW: Final = 5
THRESHOLD: Final = 3.0
MAX_TURN: Final = 50


class CirsTaobao(VirtualTaobao):
    """VirtualTaobao's users and clicks; the user leaves when two pages are ranked too similarly.

    A session terminates in the step whose action is within a Euclidean distance of `THRESHOLD` of
    one of the `WINDOW` − 1 actions before it, and is truncated after `max_turn` pages. The leave
    network is not used.

    Observation (118,): 88 user bits, zero from the second page on; the last action (27), zero on
    the first page; clicks on the last page, its index, and pages turned.

    Args:
        folder, num_envs: as for `VirtualTaobao`.
        max_turn: of the exit rule; the default is the published value.
    """

    def __init__(self, folder: Path | str, num_envs: int = 1, max_turn: int = MAX_TURN) -> None:
        super().__init__(folder, num_envs)
        self._max_turn = max_turn
        # Infinity: an empty entry has an infinite distance from every action.
        self._recent = np.full((num_envs, WINDOW - 1, ACTION_DIM), np.inf, dtype=np.float32)
        limits = np.array([MAX_CLICKS, PAGE_INDICES - 1, max_turn], dtype=np.float32)
        high = np.concatenate([np.ones(USER_BITS + ACTION_DIM, dtype=np.float32), limits])
        low = np.zeros_like(high)
        low[USER_BITS : USER_BITS + ACTION_DIM] = -1
        self.single_observation_space = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def _begin(self, rows: IntArray) -> None:
        super()._begin(rows)
        self._recent[rows] = np.inf

    def _play(self, actions: Array) -> tuple[Float32Array, BoolArray, BoolArray]:
        clicks, _, _ = super()._play(actions)
        distances = np.linalg.norm(self._recent - actions[:, None], axis=-1)
        bored = np.asarray((distances <= THRESHOLD).any(axis=1))
        self._recent = np.concatenate([self._recent[:, 1:], actions[:, None]], axis=1)
        return clicks, bored, np.asarray((self._pages >= self._max_turn) & ~bored)

    def _observe(self) -> Float32Array:
        started = self._pages[:, None] > 0
        users = np.where(started, 0, self._users)
        actions = np.where(started, self._recent[:, -1], 0)
        counts = np.concatenate([self._last, self._pages[:, None]], axis=1)
        return np.concatenate([users, actions, counts], axis=1, dtype=np.float32)


SIMULATOR: Final = Simulator(
    summary="VirtualTB-v0 with the exit rule of CIRS: similarly ranked pages end the session",
    make=lambda num_envs, folder: CirsTaobao(folder or data_folder("virtualtaobao"), num_envs),
    behaviors={**ddpg.COMMON, "mixture": mixture},
    feedback="clicks",
)
