"""D4RL's HDF5 layout: read in all its variants, written in one.

Source: https://github.com/Farama-Foundation/D4RL, `offline_env.py`; the files of this project's
data folder have the same layout.
"""

from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np

from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError, damage_explained
from ucfrec.files.atomic import atomic_file, read_json
from ucfrec_control.data.hdf5 import open_hdf5, read_numbers
from ucfrec_control.data.trajectories import Trajectories
from ucfrec_control.environments.scores import check_sizes, dataset_name, find_task

_REQUIRED = ("observations", "actions", "rewards", "terminals")
_FINAL = "infos/final_observations"


def read_d4rl(path: Path, env_id: str | None = None) -> Trajectories:
    """Read a D4RL HDF5 file.

    A trajectory ends at `terminals` or `timeouts`. Steps after the last end are an unfinished
    trajectory and are dropped; in AntMaze, so are trajectories of one step, which are the ant still
    standing on the goal. A file without `timeouts` shows where trajectories end by
    `next_observations` that the next row does not begin with.

    Args:
        env_id: environment that the data is of; None for the one that the file names, or D4RL's
            environment for the task in the file's name.

    Raises:
        InputError: the file is missing, damaged or not of this layout, or its observations and
            actions have other sizes than D4RL's of that environment.
    """
    with open_hdf5(path) as file:
        missing = [name for name in _REQUIRED if name not in file]
        if missing:
            raise InputError(
                f"{path} is not in D4RL's layout: it has no {', '.join(missing)}; it has "
                f"{', '.join(list(file)[:20]) or 'nothing'}"
            )
        steps = {name: read_numbers(file, path, name) for name in _REQUIRED}
        for name in ("timeouts", "next_observations", _FINAL):
            if name in file:
                steps[name] = read_numbers(file, path, name)
        recorded = file.attrs.get("env_id")
    _require_aligned(steps, path)
    environment = env_id or (recorded if isinstance(recorded, str) else None)
    task = find_task(environment or dataset_name(path))
    check_sizes(task, _sizes(steps), str(path))
    terminals = _flags(steps["terminals"], "terminals", path)
    ends = np.flatnonzero(terminals | _timeouts(steps, path))
    finals = _final_observations(steps, ends, path)
    lengths = np.diff(ends, prepend=-1)
    shortest = 2 if task is not None and task.name == "antmaze" else 1
    keep = lengths >= shortest
    n = int(ends[-1]) + 1 if len(ends) else 0
    rows = np.repeat(keep, lengths)
    source = {
        "where": str(path),
        "format": "d4rl",
        "dataset": dataset_name(path),
        "env_id": environment or (task.d4rl_env(dataset_name(path)) if task else None),
        "versions": _made_with(path),
        "dropped": {
            "unfinished_steps": len(terminals) - n,
            "one_step_trajectories": int(np.count_nonzero(~keep)),
        },
    }
    return Trajectories(
        observations=steps["observations"][:n][rows],
        actions=steps["actions"][:n][rows],
        rewards=steps["rewards"][:n][rows],
        lengths=lengths[keep],
        terminated=terminals[ends][keep],
        final_observations=None if finals is None else finals[keep],
        source=source,
    )


def write_d4rl(
    trajectories: Trajectories, path: Path, metadata: Mapping[str, str | int | float] | None = None
) -> None:
    """Write a D4RL HDF5 file, atomically.

    `next_observations` are written if the final observations are known.

    Args:
        metadata: further entries, written as D4RL's `metadata/NAME`.
    """
    ends = np.cumsum(trajectories.lengths) - 1
    timeouts = np.zeros(len(trajectories.rewards), dtype=bool)
    terminals = timeouts.copy()
    terminals[ends], timeouts[ends] = trajectories.terminated, ~trajectories.terminated
    columns = {
        "observations": trajectories.observations,
        "actions": trajectories.actions,
        "rewards": trajectories.rewards,
        "terminals": terminals,
        "timeouts": timeouts,
        "next_observations": _next_observations(trajectories, ends),
    }
    with atomic_file(path) as scratch, h5py.File(scratch, "w") as file:
        for name, values in columns.items():
            if values is not None:
                file.create_dataset(name, data=values, compression="gzip")
        if trajectories.source["env_id"]:
            file.attrs["env_id"] = trajectories.source["env_id"]
        for name, value in (metadata or {}).items():
            file[f"metadata/{name}"] = value


def _next_observations(trajectories: Trajectories, ends: IntArray) -> Float32Array | None:
    if trajectories.final_observations is None:
        return None
    next_observations = np.roll(trajectories.observations, -1, axis=0)
    next_observations[ends] = trajectories.final_observations
    return next_observations


def _sizes(steps: Mapping[str, Array]) -> tuple[int, ...]:
    return (*steps["observations"].shape[1:], *steps["actions"].shape[1:])


def _require_aligned(steps: Mapping[str, Array], path: Path) -> None:
    n = len(steps["rewards"]) if steps["rewards"].ndim else 0
    for name, values in steps.items():
        two = name not in ("rewards", "terminals", "timeouts")
        if values.ndim != 1 + two:
            raise InputError(f"{path}: {name} have shape {values.shape}, not {1 + two} dimensions")
        if name != _FINAL and len(values) != n:
            raise InputError(f"{path}: {name} have {len(values)} rows, rewards have {n}")
        if name.endswith("observations") and values.shape[1:] != steps["observations"].shape[1:]:
            raise InputError(
                f"{path}: {name} have {values.shape[1]} columns, observations have "
                f"{steps['observations'].shape[1]}"
            )


def _flags(values: Array, name: str, path: Path) -> BoolArray:
    """Bools; some AntMaze files store them as floats."""
    strange = int(np.count_nonzero((values != 0) & (values != 1)))
    if strange:
        raise InputError(f"{path}: {strange} of its {name} are neither 0 nor 1")
    return values.astype(bool)


def _timeouts(steps: Mapping[str, Array], path: Path) -> BoolArray:
    if "timeouts" in steps:
        return _flags(steps["timeouts"], "timeouts", path)
    if "next_observations" not in steps:
        raise InputError(
            f"{path} has neither timeouts nor next_observations, so nothing shows where its "
            "trajectories end; use a later release of the dataset"
        )
    goes_on = (steps["next_observations"][:-1] == steps["observations"][1:]).all(axis=1)
    return np.append(~goes_on, False)


def _final_observations(
    steps: Mapping[str, Array], ends: IntArray, path: Path
) -> Float32Array | None:
    if "next_observations" in steps:
        return steps["next_observations"][ends]
    if _FINAL not in steps:
        return None
    if len(steps[_FINAL]) != len(ends):
        raise InputError(
            f"{path}: {_FINAL} has {len(steps[_FINAL])} rows for {len(ends)} trajectories"
        )
    return steps[_FINAL]


def _made_with(path: Path) -> dict[str, str]:
    """Versions that the MANIFEST.json beside the file states; empty without one."""
    manifest = path.parent / "MANIFEST.json"
    if not manifest.is_file():
        return {}
    stated = read_json(manifest)
    with damage_explained(manifest, "fetch it again, or remove it"):
        files = [entry.get("file") for entry in stated.get("files", [])]
        return dict(stated.get("versions", {})) if path.name in files else {}
