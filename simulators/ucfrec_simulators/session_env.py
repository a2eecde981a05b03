"""Base classes of the environments: parallel sessions, each replaced in the step in which it
ends."""

import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ucfrec.arrays import Array, BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.errors import InputError

AnyEnv = VectorEnv[Any, Any, Any]
"""A vector environment of any observations and actions."""


def data_folder(name: str) -> Path:
    """The folder `name` in `UCFREC_DATA`, by default in `data`."""
    return Path(os.environ.get("UCFREC_DATA", "data")) / name


def draw_categories(
    probabilities: npt.NDArray[np.floating[Any]], uniforms: Float64Array
) -> IntArray:
    """One category per row, (M,) from 0 to K − 1, by inverting the cumulative distribution.

    Args:
        probabilities: (M, K); each row is proportional to its probabilities.
        uniforms: (M,) uniform draws from [0, 1).
    """
    cumulative = np.cumsum(probabilities, axis=1, dtype=np.float64)
    return np.asarray(np.argmax(cumulative > uniforms[:, None] * cumulative[:, -1:], axis=1))


class SessionsEnv(VectorEnv[Float32Array, Array, Array], ABC):
    """N parallel sessions with `AutoresetMode.SAME_STEP`.

    A step that ends a session returns the first observation of the next session, and the last one
    of the ended session in `info["final_obs"]` and `info["final_info"]`, as `SyncVectorEnv` does.
    All randomness comes from the generator that `reset(seed=…)` seeds.

    Raises:
        InputError: `num_envs` is not positive. In `step`: actions have the wrong shape, are not
            finite, or are not in the action space.
    """

    def __init__(
        self,
        num_envs: int,
        single_observation_space: spaces.Box,
        single_action_space: spaces.Box | spaces.Discrete,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs is {num_envs}; at least one session is needed")
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = single_observation_space
        self.single_action_space = single_action_space
        self.observation_space = batch_space(single_observation_space, num_envs)
        self.action_space = batch_space(single_action_space, num_envs)
        self._started = False

    @abstractmethod
    def _begin(self, rows: IntArray) -> None:
        """Start new sessions in `rows`."""

    @abstractmethod
    def _play(self, actions: Array) -> tuple[Float32Array, BoolArray, BoolArray]:
        """Advance every session one step; returns rewards, terminated and truncated, each (N,)."""

    @abstractmethod
    def _observe(self) -> Float32Array:
        """Observations (N, O) in a new array."""

    @abstractmethod
    def _describe(self) -> dict[str, Array]:
        """Entries of `info`: new arrays with one row per session."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start all sessions; returns observations (N, O) and info."""
        super().reset(seed=seed, options=options)
        self._begin(np.arange(self.num_envs))
        self._started = True
        return self._observe(), self._info(np.ones(self.num_envs, dtype=np.bool_))

    def step(
        self, actions: Array
    ) -> tuple[Float32Array, Float32Array, BoolArray, BoolArray, dict[str, Any]]:
        """Take one action in each session: vectors (N, A) or items (N,).

        Returns:
            Observations (N, O), rewards, terminated and truncated (N,), and info.

        Raises:
            InputError: the actions are not in the action space.
        """
        if not self._started:
            raise ResetNeeded("call reset before the first step")
        rewards, terminated, truncated = self._play(self._check_actions(actions))
        ended = terminated | truncated
        final: dict[str, Any] = {}
        if ended.any():
            # Gymnasium's convention is an object array that holds an observation or None.
            final_obs = np.full(self.num_envs, None, dtype=object)
            rows = np.flatnonzero(ended)
            for row, last in zip(rows, self._observe()[rows], strict=True):
                final_obs[row] = last
            final = {"final_obs": final_obs, "final_info": self._info(ended)}
            final |= {"_final_obs": ended, "_final_info": ended}
            self._begin(rows)
        all_rows = np.ones(self.num_envs, dtype=np.bool_)
        return self._observe(), rewards, terminated, truncated, self._info(all_rows) | final

    def _info(self, rows: BoolArray) -> dict[str, Array]:
        described = self._describe()
        return described | {f"_{key}": rows.copy() for key in described}

    def _check_actions(self, actions: Array) -> Array:
        space = self.action_space
        actions = np.asarray(actions)
        if actions.shape != space.shape:
            raise InputError(
                f"{type(self).__name__} takes actions of shape {space.shape}, got {actions.shape}"
            )
        if isinstance(space, spaces.MultiDiscrete):
            whole = np.issubdtype(actions.dtype, np.integer)
            if not whole or not space.contains(actions.astype(space.dtype)):
                most = space.nvec[0] - 1
                raise InputError(f"{type(self).__name__} takes whole numbers from 0 to {most}")
            return actions.astype(np.int64)
        if not np.isfinite(actions).all():
            raise InputError(f"{type(self).__name__} got actions that are not finite")
        return actions.astype(np.float32, copy=False)
