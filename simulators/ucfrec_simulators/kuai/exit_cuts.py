"""Cutting logged sequences into sessions where an exit rule would have ended them."""

from collections.abc import Sequence

import numpy as np

from ucfrec.arrays import IntArray
from ucfrec_simulators.kuai.environment import ExitRule, KuaiEnv


def sessions_by_exit(
    users: IntArray, items: IntArray, tags: Sequence[Sequence[int]], exit_rule: ExitRule
) -> IntArray:
    """Replay logged items through an exit rule, as the public code (EasyRL4Rec) makes its episodes.

    The row at which the rule ends a session, or at which the session has its maximum length, is the
    session's last; the user's next row starts a new session. All users are replayed in parallel,
    one row each per step.

    Args:
        users: (N,) user of each row; rows of a user are contiguous and in order of time.
        items: (N,) index into `tags` of the item shown.
        tags: tags of each item; an item without any gets the tag −1.
        exit_rule: when users leave.

    Returns:
        (N,) session of each row, numbered from 0 in the order of the rows.
    """
    _, starts, lengths = np.unique(users, return_index=True, return_counts=True)
    environment = KuaiEnv(len(starts), np.zeros((1, len(tags)), dtype=np.float32), tags, exit_rule)
    environment.reset(seed=0)
    last = np.zeros(len(users), dtype=np.bool_)
    for step in range(lengths.max()):
        # Users without further rows repeat their last one, whose session is ended below anyway.
        rows = starts + np.minimum(step, lengths - 1)
        _, _, terminated, truncated, _ = environment.step(items[rows])
        active = step < lengths
        last[rows[active]] = (terminated | truncated)[active]
    last[starts + lengths - 1] = True
    return np.concatenate([[0], np.cumsum(last)[:-1]])
