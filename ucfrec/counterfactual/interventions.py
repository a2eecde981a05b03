"""Copies of episodes that intervene on state dimensions without effect."""

from collections.abc import Sequence

import numpy as np

from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Overlay


def interventions(
    view: EpisodeStore, dimensions: Sequence[int], seed: int, copies: int = 2
) -> Overlay:
    """Copies of every episode of `view` under do(d ~ marginal), d being `dimensions`.

    Values are drawn, jointly, from the steps of the view. Copies 0, 2, … draw once an episode, as
    an intervention that stays put; copies 1, 3, … at every step.

    Args:
        view: a view without an overlay.
    """
    rng = np.random.default_rng(seed)
    episodes, steps = view.all_steps()
    states = view.windows(episodes, steps, 1).states[:, 0].numpy()
    edited = []
    for copy in range(copies):
        by_episode = rng.integers(len(steps), size=view.n_episodes)[episodes]
        drawn = by_episode if copy % 2 == 0 else rng.integers(len(steps), size=len(steps))
        changed = states.copy()
        changed[:, list(dimensions)] = states[drawn][:, list(dimensions)]
        edited.append(changed)
    numbers = np.arange(copies)[:, None] * view.n_episodes + episodes
    return Overlay(
        copy_source=np.tile(view.episode_ids, copies),
        edit_copy=numbers.reshape(-1),
        edit_step=np.tile(steps, copies),
        edit_state=np.concatenate(edited),
    )
