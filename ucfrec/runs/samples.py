"""Example recommendations of a finished run, shown in its report."""

from typing import Any

import numpy as np
import torch

from ucfrec import schema
from ucfrec.acting.scorer import Scorer, logged_scores
from ucfrec.episodes.store import EpisodeStore

SAMPLES = "samples.json"
_SESSIONS, _HISTORY, _ITEMS = 3, 5, 5


@torch.no_grad()
def sample_recommendations(scorer: Scorer, validation: EpisodeStore) -> dict[str, Any]:
    """Recommendations of a policy at the last step of a few validation sessions.

    Args:
        scorer: a policy of items under its rule.

    Returns:
        A JSON object: the `rule` in words, and `sessions` with up to 5 items before the last step
        (`history`), their `rewards`, the item `logged` at the last step and the 5 items
        `recommended`, best first. Items are row numbers of `items.parquet`.
    """
    long_enough = np.flatnonzero(validation.lengths >= min(2, validation.lengths.max()))
    places = np.linspace(0, len(long_enough) - 1, min(_SESSIONS, len(long_enough)))
    episodes = long_enough[places.astype(np.int64)]
    last = validation.lengths[episodes] - 1
    scores = logged_scores(scorer, validation, episodes, last)
    best = scores.topk(min(_ITEMS, len(validation.item_states.embeddings)))
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
    return {"rule": str(scorer.rule), "sessions": sessions}
