"""In-memory trajectories of a control dataset, the common form of all file formats."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from ucfrec import schema
from ucfrec.arrays import BoolArray, Float32Array, Float64Array, IntArray
from ucfrec.episodes.record import Source
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.record import Count, Entry

VALIDATION_EVERY = 20
"""One trajectory in this many belongs to the validation split."""
PACKAGES = ("gymnasium", "mujoco", "gymnasium-robotics", "minari", "h5py")
"""Packages, besides those of the core, whose versions affect numerical results."""


class Distractor(Entry):
    """A column that was appended to the observations."""

    model_config = ConfigDict(extra="allow")

    dimension: Count


class ControlSource(Entry):
    """What every control store and every run on one says of its data."""

    model_config = ConfigDict(extra="allow")

    dataset: str
    env_id: str | None
    versions: dict[str, str]
    """Of the packages that generated the data."""
    env_settings: dict[str, Any] = Field(default_factory=dict)
    distractors: tuple[Distractor, ...] = ()


def control_source(source: Source, where: Path) -> dict[str, Any]:
    """What a store or a run, maybe an untrusted one at `where`, says of its data: the entries of
    `ControlSource`, and all others.

    Raises:
        InputError: an entry is missing or has another type.
    """
    try:
        return ControlSource.model_validate(source.model_dump()).model_dump()
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        name, value = ".".join(map(str, fault["loc"])), fault["input"]
        raise InputError(
            f"{where} does not describe control data: its {name} is "
            f"{'missing' if fault['type'] == 'missing' else repr(value)[:60]}; restore it, or "
            "prepare the data again"
        ) from None


def count_of(count: int, name: str) -> str:
    """`count` numbers, as the beginning of a sentence."""
    return f"1 number of its {name} is" if count == 1 else f"{count} numbers of its {name} are"


@dataclass(frozen=True)
class Trajectories:
    """Complete trajectories, concatenated along the first axis.

    E trajectories have N steps in total, with S-dimensional observations and A-dimensional
    actions.

    Raises:
        InputError: there is no trajectory, array shapes disagree, or a value is not finite.
    """

    observations: Float32Array
    """(N, S) observation before each action."""
    actions: Float32Array
    """(N, A) action of each step, in the units of the environment."""
    rewards: Float32Array
    """(N,) reward of each step."""
    lengths: IntArray
    """(E,) number of steps of each trajectory; the sum is N."""
    terminated: BoolArray
    """(E,) whether the trajectory ended by failure or success rather than by the step limit."""
    final_observations: Float32Array | None
    """(E, S) observation after the last action; None if the source does not contain it."""
    source: Mapping[str, Any]
    """Provenance: `where` the data was read from, name of the `dataset`, `env_id` (None if
    unknown), package `versions` that generated the data, and counts of what was `dropped`."""

    def __post_init__(self) -> None:
        where, n, e = self.source["where"], len(self.rewards), len(self.lengths)
        if e == 0:
            raise InputError(
                f"{where}: no trajectory ends in it; mark ends in terminals or timeouts (Minari: "
                "terminations or truncations)"
            )
        shapes = {
            "observations": (self.observations, (n, *self.observations.shape[1:2])),
            "actions": (self.actions, (n, *self.actions.shape[1:2])),
            "rewards": (self.rewards, (n,)),
        }
        if self.final_observations is not None:
            expected_shape = (e, *self.observations.shape[1:])
            shapes["final observations"] = (self.final_observations, expected_shape)
        for name, (values, shape) in shapes.items():
            if values.shape != shape:
                raise InputError(f"{where}: {name} have shape {values.shape} instead of {shape}")
            if not values.size:
                raise InputError(f"{where}: {name} have shape {values.shape}, so no numbers")
            non_finite = int(np.count_nonzero(~np.isfinite(values)))
            if non_finite:
                raise InputError(
                    f"{where}: {count_of(non_finite, name)} not finite; remove their trajectories"
                )

    @property
    def returns(self) -> Float64Array:
        """(E,) undiscounted return, the sum of rewards, of each trajectory."""
        starts = np.cumsum(self.lengths) - self.lengths
        return np.add.reduceat(self.rewards.astype(np.float64), starts)

    def write_store(self, out: Path) -> EpisodeStore:
        """Write the trajectories as an episode store, atomically.

        One in 20, evenly spaced, belongs to the validation split: files are often ordered by
        behaviour policy, from weakest to best, so the last ones would be of a single policy.

        Raises:
            InputError: `out` already exists.
        """
        held_out = np.arange(len(self.lengths)) % VALIDATION_EVERY == VALIDATION_EVERY // 2
        steps = {schema.OBSERVATION: self.observations, schema.ACTION: self.actions}
        steps[schema.REWARD] = self.rewards
        split = held_out * schema.SPLITS.index("validation")
        ends = {schema.SPLIT: split, schema.TERMINATED: self.terminated}
        return EpisodeStore.write(out, steps, self.lengths, ends, source=self.source)
