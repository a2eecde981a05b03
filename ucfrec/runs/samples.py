"""Example recommendations of a finished run, shown in its report."""

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
    """Recommendations of `policy` at the last step of a few validation sessions.

    Args:
        policy: a policy of items.
        validation: validation episodes of items.
        target_return: target return of a whole session, in reward units; rewards before the last
            step are subtracted.

    Returns:
        A JSON object: `target_return`, and `sessions` with up to 5 items before the last step
        (`history`), their `rewards`, the item `logged` at the last step and the 5 items
        `recommended`, best first. Items are row numbers of `items.parquet`; none is filtered out.
    """
    long_enough = np.flatnonzero(validation.lengths >= min(2, validation.lengths.max()))
    places = np.linspace(0, len(long_enough) - 1, min(_SESSIONS, len(long_enough)))
    episodes = long_enough[places.astype(np.int64)]
    windows = validation.windows(episodes, validation.lengths[episodes] - 1, policy.config.context)
    # A logged return-to-go is the session's return minus its rewards so far.
    more = torch.from_numpy(target_return - validation.returns[episodes]).unsqueeze(1)
    returns_to_go = (windows.returns_to_go + more).masked_fill(~windows.mask, 0.0).float()
    windows = replace(windows, returns_to_go=returns_to_go).to(policy.state_mean.device)
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
