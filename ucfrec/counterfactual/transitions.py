"""Reading and sampling the transitions that the models are fitted to."""

from collections.abc import Callable

import numpy as np

from ucfrec.arrays import IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Transitions

Read = Callable[[EpisodeStore, IntArray, IntArray], Transitions]
"""Reads the transitions of (view, episodes, steps)."""


def sample_steps(view: EpisodeStore, limit: int, seed: int) -> tuple[IntArray, IntArray]:
    """(episodes, steps) of a view: all, or `limit` drawn with replacement if there are more."""
    if view.n_steps <= limit:
        return view.all_steps()
    return view.draw_steps(np.random.default_rng(seed), limit)


def sample_transitions(
    view: EpisodeStore, limit: int, seed: int, read: Read = EpisodeStore.transitions
) -> Transitions:
    """The transitions of `sample_steps`."""
    return read(view, *sample_steps(view, limit, seed))
