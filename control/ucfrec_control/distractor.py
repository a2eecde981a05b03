"""A distractor: a bit in the state that goes with the reward and causes nothing (Appendix G.4)."""

from pathlib import Path

import numpy as np

from ucfrec.confounder import logged_observations, reward_bit, with_observations
from ucfrec.errors import InputError
from ucfrec.store import EpisodeStore


def add_distractor(
    store: EpisodeStore, out: Path, flip: float = 0.0, seed: int = 0, early: bool = False
) -> EpisodeStore:
    """Write `store` with `ucfrec.confounder.reward_bit` after every observation.

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
