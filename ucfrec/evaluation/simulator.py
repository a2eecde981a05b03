"""What a plugin of the entry-point group `ucfrec.simulators` is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ucfrec.errors import InputError

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from ucfrec.acting.rollout import Actor


@dataclass(frozen=True)
class Simulator:
    """A simulated environment."""

    summary: str
    """One line for `--help`."""
    make: "Callable[[int, Path | None], VectorEnv[Any, Any, Any]]"
    """Makes a vector environment with `AutoresetMode.SAME_STEP` from (number of parallel sessions,
    folder of weights or None)."""
    behaviors: "Mapping[str, Callable[[VectorEnv[Any, Any, Any], int], Actor]]"
    """Built-in behavior policies by name, each made from (environment, seed): `random`, mostly
    `mixture`, which is logged by default, and `optimal` if it is known."""
    feedback: str
    """Name of the reward column in the logs that `ucfrec collect` writes."""

    @property
    def logging_behavior(self) -> str:
        """The behavior policy of logs unless another is named."""
        return "mixture" if "mixture" in self.behaviors else "random"

    def started(self, sessions: int, folder: Path | None) -> "VectorEnv[Any, Any, Any]":
        """What `make` makes of a number of parallel sessions.

        Raises:
            InputError: it is no vector environment.
        """
        from gymnasium.vector import VectorEnv

        env = self.make(sessions, folder)
        if not isinstance(env, VectorEnv):
            raise InputError(
                f"the simulator ({self.summary}) makes an object of type {type(env).__name__}; its "
                "`make` must give a gymnasium.vector.VectorEnv"
            )
        return env
