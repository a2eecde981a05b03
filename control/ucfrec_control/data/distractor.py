"""Distractors: a state bit that correlates with the reward but has no effect (Appendix G.4)."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.writer import read_observations, reward_bit, write_observations
from ucfrec.errors import InputError
from ucfrec_control.data.d4rl import read_d4rl

CLEAN = "none"
DISTRACTORS: dict[str, Mapping[str, Any] | None] = {
    CLEAN: None,
    "deterministic": {"flip": 0.0},
    "stochastic": {"flip": 0.15},
    "early": {"flip": 0.0, "early": True},
}
"""Arguments of `add_distractor` by the name used in result rows; None means no distractor.

`deterministic` and `stochastic` are the paper's. `early` indicates the next reward, which still
depends on the current action."""


def add_distractor(
    store: EpisodeStore, out: Path, flip: float = 0.0, seed: int = 0, early: bool = False
) -> EpisodeStore:
    """Write a copy of `store` with a reward-indicating bit appended to every observation.
    InputError if `reward_bit` rejects the arguments, the store holds item logs, or `out` exists.

    Args:
        flip, early: as of `ucfrec.episodes.writer.reward_bit`.
    """
    if store.has_items:
        raise InputError(f"{store.path} is of item logs; distractors are for observed states")
    bit = reward_bit(store, flip, seed, early)
    added = {"dimension": store.observation_size, "flip": flip, "seed": seed, "early": early}
    observations = np.column_stack([read_observations(store), bit])
    distractors = [*store.record.source.others.get("distractors", []), added]
    return write_observations(store, out, observations, {"distractors": distractors})


def zoo_store(data: Path, stores: Path, file: str, distractor: str = CLEAN) -> Path:
    """The store of `FILE.hdf5` in `data` with one of `DISTRACTORS`, written if it does not exist.
    InputError if the HDF5 file is missing, invalid or not that of the store, or the distractor
    cannot be added."""
    clean, path = stores / file, data / f"{file}.hdf5"
    if not clean.exists():
        read_d4rl(path).write_store(clean)
    elif path.exists() and not _is_of(clean, path):
        raise InputError(
            f"{clean} was made from other data than {path}, of the same name; name another --out"
        )
    arguments = DISTRACTORS[distractor]
    if arguments is None:
        return clean
    distracted = stores / f"{file}-{distractor}"
    if not distracted.exists():
        add_distractor(EpisodeStore.open(clean), distracted, **arguments)
    return distracted


def _is_of(folder: Path, path: Path) -> bool:
    """Whether the store in `folder` holds the data of the HDF5 file at `path`."""
    store = EpisodeStore.open(folder)
    unchanged = path.stat().st_mtime <= folder.stat().st_mtime
    if unchanged and store.record.source.others.get("where") == str(path):
        return True
    with TemporaryDirectory() as scratch:
        rewritten = read_d4rl(path).write_store(Path(scratch) / folder.name)
    return bool(rewritten.record.fingerprint == store.record.fingerprint)
