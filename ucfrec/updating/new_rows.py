"""New rows of a grown store, as a run sees them that knows fewer users and items."""

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array
from ucfrec.episodes.store import EpisodeStore
from ucfrec.runs.trained_policy import TrainedPolicy


def as_known(view: EpisodeStore, trained: TrainedPolicy) -> EpisodeStore:
    """The episodes of a view, in memory, with the item states of a run.

    Args:
        view: of a store that was grown from the run's.
        trained: the run; users and items that it does not know become −1.
    """
    assert trained.item_states is not None
    assert trained.item_ids is not None
    places = view.all_steps()
    steps: dict[str, Array] = {
        name: view.step_values(name, *places) for name in view.record.columns
    }
    items = steps[schema.ITEM]
    steps[schema.ITEM] = np.where(items < len(trained.item_ids), items, -1)
    users = view.episode_values(schema.USER)
    episodes = {
        schema.USER: np.where(users < len(trained.user_ids), users, -1),
        schema.SPLIT: np.zeros(view.n_episodes, dtype=np.uint8),
        schema.TERMINATED: view.episode_values(schema.TERMINATED),
    }
    return EpisodeStore.from_arrays(steps, view.lengths, episodes, trained.item_states)
