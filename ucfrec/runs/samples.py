"""A few recommendations of a finished run, kept for its report."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.policies.base import SequencePolicy

SAMPLES = "samples.json"
_SESSIONS, _HISTORY, _ITEMS = 3, 5, 5


@torch.no_grad()
def sample_recommendations(
    policy: SequencePolicy, validation: EpisodeStore, target_return: float
) -> dict[str, Any]:
    """What `policy` would show at the last step of a few held-out sessions.

    Args:
        validation: held-out episodes of items.
        target_return: of a whole session; what the session has earned so far is taken off.

    Returns:
        JSON-able: `target_return` and `sessions`, each with the `history` of items before the last
        step and their `rewards` (the latest 5), the item `logged` there, and the items
        `recommended`, best first. Items are rows of `items.parquet`; none is filtered out.
    """
    long_enough = np.flatnonzero(validation.lengths >= min(2, validation.lengths.max()))
    places = np.linspace(0, len(long_enough) - 1, min(_SESSIONS, len(long_enough)))
    episodes = long_enough[places.astype(np.int64)]
    windows = validation.windows(episodes, validation.lengths[episodes] - 1, policy.config.context)
    # A logged return-to-go is the session's return less what it has earned so far.
    more = torch.from_numpy(target_return - validation.returns[episodes]).unsqueeze(1)
    wanted = (windows.returns_to_go + more).masked_fill(~windows.mask, 0.0).float()
    windows = replace(windows, returns_to_go=wanted).to(policy.state_mean.device)
    best = policy.act(windows).topk(min(_ITEMS, len(validation.item_states.embeddings)))
    sessions = []
    for place, episode in enumerate(episodes):
        steps = np.arange(validation.lengths[episode])
        of_session = np.full(len(steps), episode)
        items = validation.step_values(schema.ITEM, of_session, steps)
        rewards = validation.step_values(schema.REWARD, of_session, steps)
        sessions.append(
            {
                "history": items[:-1][-_HISTORY:].tolist(),
                "rewards": rewards[:-1][-_HISTORY:].tolist(),
                "logged": int(items[-1]),
                "recommended": best.indices[place].tolist(),
            }
        )
    return {"target_return": target_return, "sessions": sessions}
