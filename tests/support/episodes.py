"""Random episodes as plain Python lists, the stores they make, and what a slow reader sees there:
one row at a time, in float64, from the documentation of `ucfrec.episodes.store` and `states`."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, Float64Array, IntArray
from ucfrec.episodes.states import ItemStates
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes, Windows

N_ITEMS, DIM, N_USERS = 11, 4, 5
LENGTHS = [3, 1, 7, 2, 5, 9, 1, 4]
SHARDS = (2**24, 6, 1)


@dataclass
class Logged:
    """One episode as it was logged."""

    rewards: list[float]
    observations: Float64Array
    """(T, O)."""
    items: list[int] = field(default_factory=list)
    actions: Float64Array | None = None
    """(T, A), of episodes without items."""
    user: int = 0
    split: int = 0

    def __len__(self) -> int:
        return len(self.rewards)

    def return_to_go(self, step: int) -> float:
        return math.fsum(self.rewards[step:])


def random_episodes(
    lengths: list[int], seed: int = 0, observation: int = 2, items: bool = True
) -> list[Logged]:
    rng = np.random.default_rng(seed)
    return [
        Logged(
            # Multiples of 1/8 are exact in float32, so sums are as well.
            rewards=list(rng.integers(-8, 25, size=n) / 8),
            observations=rng.normal(size=(n, observation)).astype(np.float32).astype(np.float64),
            items=rng.integers(N_ITEMS, size=n).tolist() if items else [],
            actions=None if items else rng.uniform(-1, 1, (n, 3)).astype(np.float32).astype("f8"),
            user=int(rng.integers(-1, N_USERS)),
            split=int(rng.integers(3)),
        )
        for n in lengths
    ]


def some_states(
    users: int = 2, window: int = 3, seed: int = 0, low: float = -1.0, high: float = 3.0
) -> ItemStates:
    """Random embeddings, and `users` features a user."""
    generator = torch.Generator().manual_seed(seed)
    embeddings = torch.randn(N_ITEMS, DIM, generator=generator)
    features = torch.randn(N_USERS, users, generator=generator)
    return ItemStates(embeddings, features, low, high, window=window, decay=0.7)


def step_columns(episodes: list[Logged]) -> dict[str, Array]:
    """Every step column there is."""
    n = sum(map(len, episodes))
    steps: dict[str, Array] = {
        schema.REWARD: np.concatenate([e.rewards for e in episodes]),
        schema.TIMESTAMP: np.arange(n) * 7 + 2**40,
        schema.PROPENSITY: np.linspace(0.1, 1.0, n),
        schema.IS_RANDOM: np.arange(n) % 3 == 0,
    }
    if episodes[0].observations.shape[1]:
        steps[schema.OBSERVATION] = np.concatenate([e.observations for e in episodes])
    if episodes[0].actions is None:
        steps[schema.ITEM] = np.concatenate([e.items for e in episodes])
    else:
        steps[schema.ACTION] = np.concatenate([e.actions for e in episodes])
    return steps


def episode_columns(episodes: list[Logged]) -> dict[str, Array]:
    """Every episode column there is."""
    return {
        schema.USER: np.array([e.user for e in episodes]),
        schema.SPLIT: np.array([e.split for e in episodes]),
        schema.TERMINATED: np.arange(len(episodes)) % 2 == 0,
    }


def lengths_of(episodes: list[Logged]) -> IntArray:
    return np.array([len(e) for e in episodes], dtype=np.int64)


def write_store(
    path: Path, episodes: list[Logged], states: ItemStates | None = None, shard_steps: int = 2**24
) -> EpisodeStore:
    """The store of `episodes`; `states` belongs to episodes with items."""
    columns = step_columns(episodes), lengths_of(episodes), episode_columns(episodes)
    store = EpisodeStore.write(path, *columns, shard_steps=shard_steps)
    if states is not None:
        states.save(path / ITEM_STATES)
    return store


def all_windows(store: EpisodeStore, length: int) -> Windows:
    return store.windows(*store.all_steps(), length)


def are_equal(a: Windows, b: Windows) -> bool:
    pairs = zip(vars(a).values(), vars(b).values(), strict=True)
    return all(x is y or torch.equal(x, y) for x, y in pairs)


def state_before(episode: Logged, step: int, states: ItemStates | None) -> Float64Array:
    """s_t in float64, straight from the documentation of `ItemStates`."""
    observation = episode.observations[step]
    if states is None:
        return observation
    embeddings = states.embeddings.double().numpy()

    def liking(reward: float) -> float:
        share = (reward - states.reward_low) / (states.reward_high - states.reward_low)
        return min(max(share, 0.0), 1.0)

    def weighted_mean(weights: list[float], vectors: list[Float64Array]) -> Float64Array:
        total = sum(weights)
        if total == 0:
            return np.zeros(embeddings.shape[1])
        return np.sum([w * v for w, v in zip(weights, vectors, strict=True)], axis=0) / total

    recent = range(step - 1, max(step - 1 - states.window, -1), -1)
    vectors = [embeddings[episode.items[t]] for t in recent]
    recency = [states.decay ** (step - 1 - t) for t in recent]
    liked = [w * liking(episode.rewards[t]) for w, t in zip(recency, recent, strict=True)]
    last = vectors[0] if vectors else np.zeros(embeddings.shape[1])
    last_liking = liking(episode.rewards[step - 1]) if vectors else 0.0
    features = states.user_features.double().numpy()
    user = features[episode.user] if episode.user >= 0 else np.zeros(features.shape[1])
    means = weighted_mean(recency, vectors), weighted_mean(liked, vectors)
    return np.concatenate([*means, last, [last_liking, math.log(1 + step)], user, observation])


def random_edits(
    store: EpisodeStore, copies: int, seed: int, share: float = 0.4
) -> tuple[AugmentedEpisodes, dict[tuple[int, int], Float32Array]]:
    """Copies of random episodes of the view, and the edits by (copy, step)."""
    rng = np.random.default_rng(seed)
    positions = rng.integers(len(store.episode_ids), size=copies)
    edits = {
        (copy, step): rng.normal(size=store.state_size).astype(np.float32)
        for copy, position in enumerate(positions)
        for step in range(int(store.lengths[position]))
        if rng.random() < share
    }
    augmented = AugmentedEpisodes(
        copy_source=store.episode_ids[positions],
        edit_copy=np.array([copy for copy, _ in edits], dtype=np.int64),
        edit_step=np.array([step for _, step in edits], dtype=np.int64),
        edit_state=np.array(list(edits.values()), dtype=np.float32).reshape(-1, store.state_size),
    )
    return augmented, edits


def random_action_copies(store: EpisodeStore, copies: int, seed: int) -> AugmentedEpisodes:
    """Copies of random episodes of the view that end at a random step with a random action."""
    rng = np.random.default_rng(seed)
    positions = rng.integers(len(store.episode_ids), size=copies)
    actions = rng.integers(N_ITEMS, size=copies)
    if not store.has_items:
        actions = rng.uniform(-1, 1, (copies, 3)).astype(np.float32)  # type: ignore[assignment]
    return replace(
        random_edits(store, 0, 0)[0],
        action_source=store.episode_ids[positions],
        action_step=rng.integers(store.lengths[positions]),
        action=actions,
        action_reward=(rng.integers(-8, 25, size=copies) / 8).astype(np.float32),
    )
