"""What a policy would have decided at the steps of logged sessions."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.acting.decision import Decider
from ucfrec.arrays import IntArray
from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows


@dataclass(frozen=True)
class SessionDecisions:
    """What a policy would have decided at B logged steps."""

    windows: Windows
    """Each step, last in its window, with the steps before it that the policy sees; an unknown item
    is −1."""
    asked: Windows
    """The windows as the policy saw them: returns-to-go from the target return."""
    scores: Tensor
    """(B, n_items), see `Decider.scores`."""
    features: Tensor | None
    """(B, d), see `Decider.act_and_features`."""


@dataclass(frozen=True)
class LoggedDecisions:
    """What was known before B logged steps, as arguments of `Decider.scores`."""

    logged: Windows
    """Each step, last in its window; an unknown item is −1."""
    windows: Windows
    """The same with known items only."""
    collected: Tensor
    forbidden: Tensor | None
    users: Tensor | None
    shown: Shown

    @classmethod
    def at(
        cls,
        decider: Decider,
        store: EpisodeStore,
        episodes: IntArray,
        steps: IntArray,
        forbidden: Tensor | None = None,
    ) -> "LoggedDecisions":
        """Read them from a store; the arguments are those of `session_scores`."""
        context = decider.policy.config.context
        reach = max(context - 1, decider.reach)
        logged = store.windows(episodes, steps, reach + 1)
        # Any known item can replace an unknown one: steps after it have weight 0.
        known = replace(logged, actions=logged.actions.clamp(min=0))
        collected = torch.from_numpy(store.rewards_before(episodes, steps))
        if decider.rule.exclude_seen:
            seen = seen_before(store, episodes, steps)
            forbidden = seen if forbidden is None else forbidden | seen
        users = None
        if store.has_users:
            users = torch.from_numpy(store.episode_values(schema.USER).astype(np.int64)[episodes])
        shown, last = Shown.before_last(known), logged.last(context)
        return cls(last, known.last(context), collected, forbidden, users, shown)


def session_decisions(
    decider: Decider,
    store: EpisodeStore,
    episodes: IntArray,
    steps: IntArray,
    forbidden: Tensor | None = None,
) -> SessionDecisions:
    """What a policy would have decided at logged steps, from what was known before each.

    Rewards earlier in a session lower what is asked for, and count as in acting.

    Args:
        decider: the policy and its rule.
        store: the logs, with the training's items; an item −1 is unknown.
        episodes: (B,) sessions.
        steps: (B,) steps of those sessions, from 0.
        forbidden: (B, n_items) or (n_items,) bool, items that may not be shown; None for none.
    """
    known = LoggedDecisions.at(decider, store, episodes, steps, forbidden)
    asked = decider.asked(known.windows, known.collected)
    outputs, features = decider.act_and_features(asked)
    scores = decider.scores_from(outputs, known.windows, known.forbidden, known.users, known.shown)
    return SessionDecisions(known.logged, asked, scores, features)


def session_scores(
    decider: Decider,
    store: EpisodeStore,
    episodes: IntArray,
    steps: IntArray,
    forbidden: Tensor | None = None,
) -> Tensor:
    """The scores (B, n_items) of `session_decisions`."""
    return session_decisions(decider, store, episodes, steps, forbidden).scores


def seen_before(store: EpisodeStore, episodes: IntArray, steps: IntArray) -> Tensor:
    """(B, n_items) bool: the known items that sessions showed before steps; see above."""
    rows, items = store.items_before(episodes, steps)
    seen = torch.zeros(len(steps), len(store.item_states.embeddings), dtype=torch.bool)
    seen[torch.from_numpy(rows[items >= 0]), torch.from_numpy(items[items >= 0])] = True
    return seen
