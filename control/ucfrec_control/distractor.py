"""A distractor: a bit in the state that goes with the reward and causes nothing (Appendix G.4)."""

from pathlib import Path

import numpy as np

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.store import EpisodeStore


def add_distractor(
    store: EpisodeStore, out: Path, flip: float = 0.0, seed: int = 0, early: bool = False
) -> EpisodeStore:
    """Write `store` with d_t = I{r_t > median r} ⊕ Bernoulli(flip) after every observation.

    The median is over all rewards of the store. All else stays, the split too. The paper's
    deterministic distractor has `flip` 0, its stochastic one 0.15.

    Args:
        early: reveal the bit one step early, d_t = I{r_{t+1} > median r}; the last step of an
            episode has no next reward and tells its own.

    Raises:
        InputError: `flip` is no probability, the store's states are made of items, or `out` exists.
    """
    if not 0 <= flip <= 1:
        raise InputError(f"the distractor's chance of being wrong is {flip}; it lies in [0, 1]")
    if store.has_items:
        raise InputError(f"{store.path} is of item logs; distractors are for observed states")
    episodes, steps = store.all_steps()
    columns = {name: store.step_values(name, episodes, steps) for name in store.meta["columns"]}
    rewards = columns[schema.REWARD]
    wrong = np.random.default_rng(seed).random(len(rewards)) < flip
    told = np.minimum(steps + 1, store.lengths[episodes] - 1) if early else steps
    bit = (store.step_values(schema.REWARD, episodes, told) > np.median(rewards)) ^ wrong
    columns[schema.OBSERVATION] = np.column_stack([columns[schema.OBSERVATION], bit])
    source = store.meta["source"]
    added = {"dimension": store.observation_size, "flip": flip, "seed": seed, "early": early}
    return EpisodeStore.write(
        out,
        columns,
        store.lengths,
        {name: store.episode_values(name) for name in (schema.SPLIT, schema.TERMINATED)},
        reward=store.meta["reward"],
        source={**source, "distractors": [*source.get("distractors", []), added]},
    )
