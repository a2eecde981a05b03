"""Windows of running sessions are those of a store with the same rows, to the last bit."""

import numpy as np
import pytest
import torch

from tests.support.episodes import N_ITEMS, some_states
from ucfrec import schema
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Sessions, Windows

USERS = 3


@pytest.mark.parametrize("context", [1, 4, 20])
@pytest.mark.parametrize("observation", [0, 2])
def test_windows_are_those_of_a_store(context: int, observation: int) -> None:
    rng, states = np.random.default_rng(context), some_states(USERS, 5)
    counts = np.array([0, 1, 30, 3, 7])
    owner = np.repeat(np.arange(len(counts)), counts)
    items, rewards = rng.integers(N_ITEMS, size=41), rng.normal(size=41).astype(np.float32)
    users = rng.integers(-1, USERS, size=len(counts))
    seen = rng.normal(size=(len(counts), observation)).astype(np.float32)
    # The store has the step to decide too, whose item and reward count for nothing.
    ends = np.cumsum(counts)
    columns = {schema.ITEM: np.insert(items, ends, 0), schema.REWARD: np.insert(rewards, ends, 0)}
    if observation:
        columns[schema.OBSERVATION] = np.repeat(seen, counts + 1, axis=0)
    store = EpisodeStore.from_arrays(columns, counts + 1, {schema.USER: users}, states)
    expected = store.windows(np.arange(len(counts)), counts, context)
    observations = torch.from_numpy(seen).unsqueeze(1).expand(-1, 25, -1) if observation else None
    at = store, np.arange(len(counts)), counts
    for length in (context - 1 + states.window, 60):
        requested = Sessions.from_rows(owner, items, rewards, users, length, observations)
        logged = Sessions.from_store(*at, context, length)
        for sessions in (requested, logged):
            _compare(sessions, states, context, expected)
            collected = np.bincount(owner, rewards, minlength=len(counts))
            np.testing.assert_allclose(sessions.collected.numpy(), collected)
            assert sessions.shown.items[2, :3].tolist() == items[30:27:-1].tolist()


def _compare(sessions: Sessions, states: ItemStates, context: int, expected: Windows) -> None:
    """The windows are the expected ones but for the step to decide."""
    windows = sessions.windows(states, context)
    for name in ("states", "timesteps", "mask"):
        assert torch.equal(getattr(windows, name), getattr(expected, name))
    for name in ("actions", "rewards"):
        assert torch.equal(getattr(windows, name)[:, :-1], getattr(expected, name)[:, :-1])
        assert not getattr(windows, name)[:, -1].any()
