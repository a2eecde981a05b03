"""A distractor: a bit in the state, correlated with the reward, without effect (Appendix G.4)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ucfrec.episodes.distractor import logged_observations, reward_bit, with_observations
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec_control.data.d4rl import read_d4rl

CLEAN = "none"
DISTRACTORS: dict[str, Mapping[str, Any] | None] = {
    CLEAN: None,
    "deterministic": {"flip": 0.0},
    "stochastic": {"flip": 0.15},
    "early": {"flip": 0.0, "early": True},
}
"""Arguments of `add_distractor` by the name in the rows; the first two distractors are the paper's,
the last indicates the next reward, which still depends on the current action."""


def add_distractor(
    store: EpisodeStore, out: Path, flip: float = 0.0, seed: int = 0, early: bool = False
) -> EpisodeStore:
    """Write `store` with `ucfrec.episodes.distractor.reward_bit` after every observation.

    Raises:
        InputError: as `reward_bit`, the store's states are made of items, or `out` exists.
    """
    if store.has_items:
        raise InputError(f"{store.path} is of item logs; distractors are for observed states")
    bit = reward_bit(store, flip, seed, early)
    added = {"dimension": store.observation_size, "flip": flip, "seed": seed, "early": early}
    return with_observations(
        store,
        out,
        np.column_stack([logged_observations(store), bit]),
        {"distractors": [*store.meta["source"].get("distractors", []), added]},
    )


def zoo_store(data: Path, stores: Path, file: str, distractor: str = CLEAN) -> Path:
    """The store of `data / FILE.hdf5`, with a key of `DISTRACTORS`; written where it is not yet."""
    clean = stores / file
    if not clean.exists():
        read_d4rl(data / f"{file}.hdf5").write_store(clean)
    arguments = DISTRACTORS[distractor]
    if arguments is None:
        return clean
    distracted = stores / f"{file}-{distractor}"
    if not distracted.exists():
        add_distractor(EpisodeStore.open(clean), distracted, **arguments)
    return distracted
