"""A distractor: a bit that is correlated with the reward in the logs and causes nothing (Appendix
G.4)."""

import hashlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files import atomic_folder, write_json


def reward_bit(
    store: EpisodeStore, flip: float = 0.0, seed: int = 0, early: bool = False
) -> npt.NDArray[np.float32]:
    """d_t = I{r_t high} ⊕ Bernoulli(flip) of every step, (n_steps,) in the order of `all_steps`.

    A reward is high if it is above the median of all rewards; where the median is the largest
    reward (more than half of all steps are clicks), if it is the median. The paper's deterministic
    distractor has `flip` 0, its stochastic one 0.15.

    Args:
        store: a store or a view of it.
        flip: probability that a bit is wrong, in [0, 1].
        seed: of the wrong bits.
        early: reveal the bit one step early, d_t = I{r_{t+1} high}; the last step of an episode has
            no next reward and reveals its own.

    Raises:
        InputError: `flip` is no probability, or all rewards are equal.
    """
    if not 0 <= flip <= 1:
        raise InputError(f"the probability of a wrong bit is {flip}; a probability lies in [0, 1]")
    episodes, steps = store.all_steps()
    rewards = store.step_values(schema.REWARD, episodes, steps)
    if rewards.min() == rewards.max():
        raise InputError(
            f"all rewards of {store.path} are {rewards[0]:g}; no bit can be correlated with them"
        )
    median = np.median(rewards)
    revealed = np.minimum(steps + 1, store.lengths[episodes] - 1) if early else steps
    shown = store.step_values(schema.REWARD, episodes, revealed)
    high = shown > median if median < rewards.max() else shown >= median
    wrong = np.random.default_rng(seed).random(len(rewards)) < flip
    return np.asarray(high ^ wrong, dtype=np.float32)


def with_observations(
    store: EpisodeStore,
    out: Path,
    observations: npt.NDArray[np.float32],
    source: Mapping[str, Any],
) -> EpisodeStore:
    """Write `store` with other observations; every other file stays as it is.

    Args:
        store: a whole store, not a view of some episodes.
        out: folder of the new store.
        observations: (n_steps, O) in the order of `all_steps`.
        source: added to the store's record of what it was made from.

    Raises:
        InputError: `out` exists.
    """
    values = np.ascontiguousarray(observations, dtype=schema.STEP_DTYPES[schema.OBSERVATION])
    digest = hashlib.sha256(store.meta["fingerprint"].encode() + values.tobytes()).hexdigest()
    with atomic_folder(out) as scratch:
        shutil.copytree(store.path, scratch, dirs_exist_ok=True)
        begin = 0
        for shard in sorted(scratch.glob("shard-*")):
            end = begin + int(np.load(shard / "offsets.npy")[-1])
            np.save(shard / f"{schema.OBSERVATION}.npy", values[begin:end])
            begin = end
        meta = {
            **store.meta,
            "columns": {**store.meta["columns"], schema.OBSERVATION: [values.shape[1]]},
            "fingerprint": digest,
            "source": {**store.meta["source"], **source},
        }
        write_json(scratch / "meta.json", meta)
    return EpisodeStore.open(out)


def logged_observations(store: EpisodeStore) -> npt.NDArray[np.float32]:
    """(n_steps, O) in the order of `all_steps`; O is 0 where none were logged."""
    if not store.observation_size:
        return np.zeros((store.n_steps, 0), dtype=np.float32)
    return np.asarray(store.step_values(schema.OBSERVATION, *store.all_steps()))
