"""Distractors: an observed bit that correlates with the reward in the logs without causing it
(paper appendix G.4)."""

import hashlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Float32Array
from ucfrec.episodes.record import Source
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder


def reward_bit(
    store: EpisodeStore, flip: float = 0.0, seed: int = 0, early: bool = False
) -> Float32Array:
    """The distractor d_t = I{r_t is high} ⊕ Bernoulli(flip) of every step (paper appendix G.4).

    A reward is high if it exceeds the median of all rewards; if the median equals the largest
    reward (more than half of all steps are clicks), a reward is high if it equals the median. The
    paper's deterministic distractor has `flip` 0, the stochastic one 0.15.

    Args:
        store: a store or a view of it.
        flip: probability that a bit is inverted, in [0, 1].
        early: shift the bit one step ahead, d_t = I{r_{t+1} is high}; the last step of an episode,
            which has no next reward, uses its own reward.

    Returns:
        (n_steps,) float32, 0 or 1, in the order of `all_steps`.

    Raises:
        InputError: `flip` is not a probability, or all rewards are equal.
    """
    if not 0 <= flip <= 1:
        raise InputError(f"flip, the probability of a wrong bit, is {flip}; it must be in [0, 1]")
    episodes, steps = store.all_steps()
    rewards = store.step_values(schema.REWARD, episodes, steps)
    if rewards.min() == rewards.max():
        raise InputError(
            f"all rewards of {store.path} are {rewards[0]:g}, so no distractor can correlate with "
            "them; check the reward expression"
        )
    median = np.median(rewards)
    revealed_steps = np.minimum(steps + 1, store.lengths[episodes] - 1) if early else steps
    revealed = store.step_values(schema.REWARD, episodes, revealed_steps)
    high = revealed > median if median < rewards.max() else revealed >= median
    flipped = np.random.default_rng(seed).random(len(rewards)) < flip
    return np.asarray(high ^ flipped, dtype=np.float32)


def with_observations(
    store: EpisodeStore,
    out: Path,
    observations: Float32Array,
    source: Mapping[str, Any],
) -> EpisodeStore:
    """Write a copy of `store` with other observations, atomically.

    Args:
        store: a whole store in a folder, not a view of some episodes.
        observations: (n_steps, O) in the order of `all_steps`.
        source: added to `source` in `meta.json`, the record of what the store was made from.

    Raises:
        InputError: `out` exists already.
    """
    values = np.ascontiguousarray(observations, dtype=schema.STEP_DTYPES[schema.OBSERVATION])
    digest = hashlib.sha256(store.record.fingerprint.encode() + values.tobytes()).hexdigest()
    with atomic_folder(out) as scratch:
        shutil.copytree(store.path, scratch, dirs_exist_ok=True)
        begin = 0
        for shard in sorted(scratch.glob("shard-*")):
            end = begin + int(np.load(shard / "offsets.npy")[-1])
            np.save(shard / f"{schema.OBSERVATION}.npy", values[begin:end])
            begin = end
        changed = f"{schema.OBSERVATION}.npy"
        files = store.record.files.items()
        store.record.copy_with(
            files={name: entry for name, entry in files if not name.endswith(f"/{changed}")},
            columns={**store.record.columns, schema.OBSERVATION: [values.shape[1]]},
            fingerprint=digest,
            source=Source.model_validate({**store.record.source.model_dump(), **source}),
        ).seal(scratch)
    return EpisodeStore.open(out)


def logged_observations(store: EpisodeStore) -> Float32Array:
    """The observations (n_steps, O) in the order of `all_steps`; O is 0 if none were logged."""
    if not store.observation_size:
        return np.zeros((store.n_steps, 0), dtype=np.float32)
    return np.asarray(store.step_values(schema.OBSERVATION, *store.all_steps()))
