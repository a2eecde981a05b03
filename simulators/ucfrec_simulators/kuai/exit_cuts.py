"""Logged sequences cut where an exit rule would have ended them."""

from collections.abc import Sequence

import numpy as np

from ucfrec.acting.rollout import IntArray
from ucfrec_simulators.kuai.environment import ExitRule, KuaiEnv


def sessions_by_exit(
    users: IntArray, items: IntArray, tags: Sequence[Sequence[int]], exit_rule: ExitRule
) -> IntArray:
    """Replay what users were shown through an exit rule, as the public code makes its episodes.

    A row that ends a session, by boredom or by the rule's longest, is its last; the user's next row
    begins another. All users are replayed at once, a row each a step.

    Args:
        users: (N,) whose row it is; rows of a user lie together, in order of time.
        items: (N,) number of the item shown, a place in `tags`.
        tags: of each item; none stands for the tag −1.

    Returns:
        (N,) session of each row, numbered from 0 in the order of the rows.
    """
    _, starts, lengths = np.unique(users, return_index=True, return_counts=True)
    world = KuaiEnv(len(starts), np.zeros((1, len(tags)), dtype=np.float32), tags, exit_rule)
    world.reset(seed=0)
    last = np.zeros(len(users), dtype=np.bool_)
    for step in range(lengths.max()):
        # Users whose rows are over go on with their last one, which is ended below in any case.
        at = starts + np.minimum(step, lengths - 1)
        _, _, terminated, truncated, _ = world.step(items[at])
        there = step < lengths
        last[at[there]] = (terminated | truncated)[there]
    last[starts + lengths - 1] = True
    return np.concatenate([[0], np.cumsum(last)[:-1]])
