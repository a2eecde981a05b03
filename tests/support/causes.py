"""Stores in which it is known what causes what."""

from pathlib import Path

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Float64Array
from ucfrec.episodes.store import EpisodeStore

SOURCE = {"where": "planted", "dataset": "planted", "env_id": None, "versions": {}}


def written(
    out: Path, states: Float64Array, actions: Float64Array, rewards: Float64Array
) -> EpisodeStore:
    """The store of states (E, T, S), actions (E, T, 1) and rewards (E, T)."""
    trajectories, length = rewards.shape
    columns = {
        schema.OBSERVATION: states.reshape(-1, states.shape[2]).astype(np.float32),
        schema.ACTION: actions.reshape(-1, 1).astype(np.float32),
        schema.REWARD: rewards.reshape(-1).astype(np.float32),
    }
    # As control stores are split: every twentieth is for validation.
    split = {schema.SPLIT: (np.arange(trajectories) % 20 == 10).astype(np.int8)}
    return EpisodeStore.write(out, columns, np.full(trajectories, length), split, source=SOURCE)


def planted_vectors(
    out: Path, trajectories: int = 60, length: int = 40, jolt: float = 0.0
) -> EpisodeStore:
    """Five dimensions: 0 drives 1, 1 drives 0 and the reward, 2 the reward alone, 3 measures the
    reward, 4 is noise. 3 and 4 have no effect. In 0.3% of the steps 1 is jolted by `jolt`."""
    rng = np.random.default_rng(0)
    shape = (trajectories, length)
    states, actions = np.zeros((*shape, 5)), rng.uniform(-1, 1, (*shape, 1))
    states[:, :, [2, 4]] = rng.normal(size=(*shape, 2))
    states[:, 0, :2] = rng.normal(size=(trajectories, 2))
    for t in range(length - 1):
        x, y = states[:, t, 0], states[:, t, 1]
        states[:, t + 1, 0] = 0.8 * x + 0.5 * np.tanh(y) + 0.2 * actions[:, t, 0]
        states[:, t + 1, 1] = 0.7 * y - 0.6 * x + 0.3 * rng.normal(size=trajectories)
        if jolt:
            states[:, t + 1, 1] += jolt * (rng.random(trajectories) < 0.003)
    rewards = states[:, :, 1] + np.abs(states[:, :, 2]) + 0.3 * actions[:, :, 0]
    states[:, :, 3] = rewards > np.median(rewards)
    return written(out, states, actions, rewards)


def planted_category(
    out: Path, trajectories: int = 150, length: int = 12, moves: float = 0.5, noise: float = 0.0
) -> EpisodeStore:
    """Eight dimensions: 0 drives itself and the reward, 1 to 5 are of a category that a trajectory
    keeps and that moves the reward by `moves`, 6 is whether the reward is high, 7 is 0. `noise` is
    the standard deviation of what nothing explains of the reward."""
    rng = np.random.default_rng(0)
    shape = (trajectories, length)
    states, actions = np.zeros((*shape, 8)), rng.uniform(-1, 1, (*shape, 1))
    category = rng.integers(5, size=trajectories)
    states[np.arange(trajectories), :, 1 + category] = 1.0
    states[:, 0, 0] = rng.normal(size=trajectories)
    for t in range(length - 1):
        drift = 0.3 * rng.normal(size=trajectories)
        states[:, t + 1, 0] = 0.8 * states[:, t, 0] + 0.4 * actions[:, t, 0] + drift
    rewards = states[:, :, 0] + moves * category[:, None] + 0.8 * actions[:, :, 0]
    rewards += noise * np.random.default_rng(1).normal(size=shape)
    states[:, :, 6] = rewards > np.median(rewards)
    return written(out, states, actions, rewards)
