"""Sessions that are much longer than most, as those of bots are."""

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore

LONG: Final = 100
"""Times the median from which on a session is hardly a person's."""


def of_people(view: "EpisodeStore") -> "EpisodeStore":
    """The view without sessions of more than `LONG` times the median number of steps.

    One session of thousands of steps would otherwise set the largest target return, be a good part
    of the rows that the user model is fitted to, and let simulated sessions go on as long.

    Args:
        view: of a store of items, without augmentation; the same is returned if it has no such
            session.
    """
    if not view.n_episodes:
        return view
    usual = view.lengths <= LONG * np.median(view.lengths)
    return view if usual.all() else view.select(np.flatnonzero(usual))
