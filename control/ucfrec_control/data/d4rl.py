"""D4RL's HDF5 layout: read in all its variants, written in one; and untrusted HDF5 files.

Source: https://github.com/Farama-Foundation/D4RL, `offline_env.py`; the files of this project's
data folder have the same layout. Of a file that is read, nothing outside it is opened, and nothing
is taken that is larger than it can hold.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from ucfrec.arrays import Array, BoolArray, Float32Array
from ucfrec.errors import InputError, damage_explained, one_line
from ucfrec.files.atomic import atomic_file, read_json
from ucfrec_control.data.trajectories import Trajectories, count_of
from ucfrec_control.environments.scores import check_sizes, dataset_name, find_task

_REQUIRED = ("observations", "actions", "rewards", "terminals")
_FINAL = "infos/final_observations"
_DEFLATE: Final = 1032
"""Largest factor by which deflate shrinks; more than that cannot be in a file."""
_FAULTS: Final = (OSError, ValueError, TypeError, RuntimeError, KeyError, AttributeError)
"""What h5py raises for damaged files; `OSError` and `RuntimeError` carry the library's messages."""


def read_d4rl(path: Path, env_id: str | None = None) -> Trajectories:
    """Read a D4RL HDF5 file.

    A trajectory ends at `terminals` or `timeouts`. Steps after the last end are an unfinished
    trajectory and are dropped; in AntMaze, so are trajectories of one step, which are the ant still
    standing on the goal. A file without `timeouts` shows where trajectories end by
    `next_observations` that the next row does not begin with. InputError if the file is missing,
    damaged or not of this layout, or its observations and actions have other sizes than D4RL's of
    that environment.

    Args:
        env_id: environment that the data is of; None for the one that the file names, or D4RL's
            environment for the task in the file's name.
    """
    with open_hdf5(path) as file:
        missing = [name for name in _REQUIRED if name not in file]
        if missing:
            raise InputError(
                f"{path} is not in D4RL's layout: it has no {', '.join(missing)}; it has "
                f"{', '.join(list(file)[:20]) or 'nothing'}"
            )
        steps = {name: read_numbers(file, path, name) for name in _REQUIRED}
        more = [name for name in ("timeouts", "next_observations", _FINAL) if name in file]
        steps |= {name: read_numbers(file, path, name) for name in more}
        recorded = file.attrs.get("env_id")
    if isinstance(recorded, bytes):
        recorded = recorded.decode(errors="replace")
    _require_aligned(steps, path)
    environment = env_id or (recorded if isinstance(recorded, str) else None)
    task = find_task(environment or dataset_name(path))
    sizes = (*steps["observations"].shape[1:], *steps["actions"].shape[1:])
    check_sizes(task, sizes, str(path))
    terminals = _flags(steps["terminals"], "terminals", path)
    ends = np.flatnonzero(terminals | _timeouts(steps, path))
    finals = steps.get(_FINAL)
    if "next_observations" in steps:
        finals = steps["next_observations"][ends]
    elif finals is not None and len(finals) != len(ends):
        raise InputError(f"{path}: {_FINAL} has {len(finals)} rows for {len(ends)} trajectories")
    lengths = np.diff(ends, prepend=-1)
    keep = lengths > (task is not None and task.name == "antmaze")
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
        **{name: steps[name][:n][rows] for name in ("observations", "actions", "rewards")},
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
    columns = {name: getattr(trajectories, name) for name in ("observations", "actions", "rewards")}
    columns |= {"terminals": terminals, "timeouts": timeouts}
    if trajectories.final_observations is not None:
        columns["next_observations"] = np.roll(trajectories.observations, -1, axis=0)
        columns["next_observations"][ends] = trajectories.final_observations
    with atomic_file(path) as scratch, h5py.File(scratch, "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, compression="gzip")
        if trajectories.source["env_id"]:
            file.attrs["env_id"] = trajectories.source["env_id"]
        for name, value in (metadata or {}).items():
            file[f"metadata/{name}"] = value


def _require_aligned(steps: Mapping[str, Array], path: Path) -> None:
    n = len(steps["rewards"]) if steps["rewards"].ndim else 0
    for name, values in steps.items():
        form = "(N,)" if name in ("rewards", "terminals", "timeouts") else "(N, size)"
        if values.ndim != len(form.split()):
            raise InputError(f"{path}: {name} have shape {values.shape}; write them as {form}")
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
            "trajectories end; use a later release of D4RL, or write timeouts, false without limit"
        )
    goes_on = (steps["next_observations"][:-1] == steps["observations"][1:]).all(axis=1)
    return np.append(~goes_on, False)


def _made_with(path: Path) -> dict[str, str]:
    """Versions that the MANIFEST.json beside the file states; empty without one."""
    manifest = path.parent / "MANIFEST.json"
    if not manifest.is_file():
        return {}
    stated = read_json(manifest)
    with damage_explained(manifest, "fetch it again, or remove it"):
        files = [entry.get("file") for entry in stated.get("files", [])]
        return dict(stated.get("versions", {})) if path.name in files else {}


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Yield the file, opened for reading, in which no link leads out of it. InputError if the file
    is missing, damaged or not HDF5, links to another file or stores values in one, or reading it in
    the block fails."""
    if not path.is_file():
        raise InputError(f"{path} {'is not an HDF5 file' if path.exists() else 'does not exist'}")
    try:
        # HDF5's own lock needs a writable file system and would only keep out other HDF5 writers.
        with h5py.File(path, "r", locking=False) as file:
            for name in file:
                _require_inside(file, name, path)
            yield file
    except InputError:
        raise
    except (*_FAULTS, MemoryError) as error:
        raise InputError(
            f"{path} is damaged or not HDF5 ({first_line(error)}); fetch it again"
        ) from None


def read_numbers(file: Any, path: Path, name: str) -> Array:
    """A data set of numbers in memory, of at most two dimensions; floats become float32. InputError
    if it is not a data set of numbers, claims more values than the file can hold, has numbers
    beyond single precision, or cannot be read.

    Args:
        name: of the data set, which may lie in groups: `infos/final_observations`.
    """
    dataset = file
    for part in name.split("/"):
        _require_inside(dataset, part, path)
        dataset = dataset[part]
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{path}: {name} is a group, not a data set")
    _require_own_values(dataset, path, name)
    if dataset.dtype.kind not in "fiub" or dataset.dtype.subdtype is not None:
        raise InputError(f"{path}: {name} holds {dataset.dtype}, not numbers")
    shape = dataset.shape or ()
    if len(shape) > 2:
        raise InputError(f"{path}: {name} have shape {shape}, not 1 or 2 dimensions")
    try:
        values = np.asarray(dataset)
    except (*_FAULTS, MemoryError) as error:
        raise InputError(
            f"{path}: {name} cannot be read ({first_line(error)}); fetch the file again"
        ) from None
    return convert_singles(values, str(path), name) if values.dtype.kind == "f" else values


def convert_singles(values: Array, where: str, name: str) -> Float32Array:
    """Numbers from the source `where`, called `name` in the plural, in single precision. InputError
    if a finite number is beyond single precision."""
    with np.errstate(over="ignore"):
        singles = values.astype(np.float32)
    beyond = int(np.count_nonzero(np.isinf(singles) & np.isfinite(values)))
    if beyond:
        raise InputError(
            f"{where}: {count_of(beyond, name)} beyond single precision "
            f"(±{np.finfo(np.float32).max:.2g}); scale the {name}, or remove their trajectories"
        )
    return singles


def require_inside(path: Path) -> None:
    """Check that no data set or group of a file leads out of it. InputError if one does, or
    the file is damaged."""
    with open_hdf5(path) as file:
        waiting, seen = [file], 0
        while waiting:
            group = waiting.pop()
            for name in group:
                _require_inside(group, name, path)
                child = group[name]
                seen += 1
                if seen > 10_000_000:  # groups may lie in one another
                    raise InputError(f"{path} has more than 10 million entries")
                if isinstance(child, h5py.Group):
                    waiting.append(child)
                else:
                    _require_own_values(child, path, str(child.name))


def _require_inside(group: Any, name: str, path: Path) -> None:
    """Check that an entry of a group is neither an external nor a soft link."""
    link = group.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        kind = "another file" if isinstance(link, h5py.ExternalLink) else "another name"
        raise InputError(f"{path}: {name} is a link to {kind}, which is not followed; copy it")


def _require_own_values(dataset: Any, path: Path, name: str) -> None:
    """Check that the values are in the file, before memory is allocated for them."""
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{path}: the values of {name} lie in another file; copy them into this")
    stored = min(int(dataset.id.get_storage_size()), path.stat().st_size)
    factor = _DEFLATE if dataset.id.get_create_plist().get_nfilters() else 1
    numbers = dataset.dtype.kind in "fiub"
    if numbers and dataset.size * dataset.dtype.itemsize > stored * factor:
        raise InputError(
            f"{path}: {name} claims the shape {dataset.shape}, but only {stored:,} bytes are "
            "stored; fetch the file again"
        )


def first_line(error: BaseException) -> str:
    """The message of an error on one line; its type if it has none."""
    return one_line((str(error).splitlines() or [""])[0]) or type(error).__name__
