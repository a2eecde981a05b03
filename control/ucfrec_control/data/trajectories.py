"""Trajectories of a control dataset in memory: what every format is read to and written from."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

VALIDATION_EVERY = 20
"""One trajectory in this many is for validation."""
PACKAGES = ("gymnasium", "mujoco", "gymnasium-robotics", "minari", "h5py")
"""Packages, beside the core's, whose versions decide numbers."""


@dataclass(frozen=True)
class Trajectories:
    """Whole trajectories, one after the other.

    Raises:
        InputError: arrays disagree, or hold what is not finite.
    """

    observations: FloatArray
    """(N, S)."""
    actions: FloatArray
    """(N, A)."""
    rewards: FloatArray
    """(N,)."""
    lengths: IntArray
    """(E,) steps of each trajectory, adding up to N."""
    terminated: BoolArray
    """(E,) ended by failure or success, not by the step limit."""
    final_observations: FloatArray | None
    """(E, S) what the last action led to; None where the source does not tell."""
    source: Mapping[str, Any]
    """`where` it was read, `dataset`, `env_id` (None if unknown), `versions` it was made with,
    and what was `dropped`."""

    def __post_init__(self) -> None:
        where, n, e = self.source["where"], len(self.rewards), len(self.lengths)
        if e == 0:
            raise InputError(f"{where}: no trajectory ends in it; it holds unfinished steps only")
        shapes = {
            "observations": (self.observations, (n, *self.observations.shape[1:2])),
            "actions": (self.actions, (n, *self.actions.shape[1:2])),
            "rewards": (self.rewards, (n,)),
        }
        if self.final_observations is not None:
            wanted = (e, *self.observations.shape[1:])
            shapes["final observations"] = (self.final_observations, wanted)
        for name, (values, shape) in shapes.items():
            if values.shape != shape:
                raise InputError(f"{where}: {name} have shape {values.shape} instead of {shape}")
            strange = int(np.count_nonzero(~np.isfinite(values)))
            if strange:
                raise InputError(f"{where}: {strange} numbers of its {name} are not finite")

    @property
    def returns(self) -> npt.NDArray[np.float64]:
        """(E,) return of each trajectory."""
        starts = np.cumsum(self.lengths) - self.lengths
        return np.add.reduceat(self.rewards.astype(np.float64), starts)

    def write_store(self, out: Path) -> EpisodeStore:
        """Write an episode store, atomically.

        One trajectory in 20, evenly spaced, is for validation. Trajectories of control data are
        independent, so nothing is gained by holding out the last ones; and files are ordered by
        behaviour, often weakest to best, so the last ones would be of one behaviour only.

        Raises:
            InputError: `out` exists.
        """
        held_out = np.arange(len(self.lengths)) % VALIDATION_EVERY == VALIDATION_EVERY // 2
        return EpisodeStore.write(
            out,
            {
                schema.OBSERVATION: self.observations,
                schema.ACTION: self.actions,
                schema.REWARD: self.rewards,
            },
            self.lengths,
            {
                schema.SPLIT: held_out * schema.SPLITS.index("validation"),
                schema.TERMINATED: self.terminated,
            },
            source=self.source,
        )
