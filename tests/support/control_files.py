"""Control datasets made up for tests, and files of them in D4RL's layout."""

from pathlib import Path

import h5py
import numpy as np

from ucfrec.arrays import Array

Columns = dict[str, Array]


def hopper_like(lengths: tuple[int, ...] = (4, 1, 6, 3), seed: int = 0) -> Columns:
    """Columns of a Hopper-sized file; every second trajectory ends by the step limit."""
    rng = np.random.default_rng(seed)
    n = sum(lengths)
    ends = np.cumsum(lengths) - 1
    terminals, timeouts = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    terminals[ends[::2]], timeouts[ends[1::2]] = True, True
    observations = rng.normal(size=(n, 11)).astype(np.float32)
    finals = rng.normal(size=(len(lengths), 11)).astype(np.float32)
    following = np.vstack([observations[1:], observations[:1]])
    following[ends] = finals
    return {
        "observations": observations,
        "actions": rng.uniform(-1, 1, size=(n, 3)).astype(np.float32),
        "rewards": rng.normal(size=n).astype(np.float32),
        "terminals": terminals,
        "timeouts": timeouts,
        "next_observations": following,
        "infos/final_observations": finals,
    }


def write_hdf5(path: Path, columns: Columns, env_id: str | None = "Hopper-v5") -> Path:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values
        if env_id is not None:
            file.attrs["env_id"] = env_id
    return path
