"""Sessions played in an environment, and their steps side by side."""

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from ucfrec.acting.rollout import Actor, Episodes, Step, rollout
from ucfrec.arrays import Array

NAMES = ("episodes", "observations", "actions", "rewards", "user_ids", "propensities")


def play(
    env: VectorEnv[Any, Any, Any], actor: Actor, episodes: int, seed: int
) -> tuple[Episodes, dict[str, Array]]:
    """The episodes, and of every step in order what is known of it."""
    steps: list[Step] = []
    played = rollout(env, actor, episodes, seed, steps.append)
    columns = {name: [getattr(step, name) for step in steps] for name in NAMES}
    known = {name: parts for name, parts in columns.items() if parts[0] is not None}
    return played, {name: np.concatenate(parts) for name, parts in known.items()}
