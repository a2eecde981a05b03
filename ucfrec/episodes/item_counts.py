"""How often each item was shown, and how often it was liked, in the training log."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors

LIKED = 0.6
"""A step counts as liked if its reward, scaled to [0, 1] as in item states, is at least this: the
threshold on the normalised watch ratio in the published dominance metric; a click is liked."""
_Reward = TypeVar("_Reward", float, Tensor)


def least_liked(low: _Reward, high: _Reward) -> _Reward:
    """The lowest reward of a liked step, where training rewards are from `low` to `high`."""
    return low + LIKED * (high - low)


def liked_rewards(store: EpisodeStore, rewards: Array) -> BoolArray:
    """Whether steps were liked: their reward is at least `least_liked`.

    Args:
        store: a view of a store of items.
        rewards: (N,) of some of its steps.

    Returns:
        (N,) bool.
    """
    states = store.item_states
    return np.asarray(rewards >= least_liked(states.reward_low, states.reward_high))


@dataclass(frozen=True)
class TrainingCounts:
    """Counts of items in the training log, for novelty and dominance; items in store order."""

    shown: Tensor
    """(n_items,) int64 number of training steps that showed each item."""
    liked: Tensor
    """(n_items,) int64 number of those steps that were liked."""
    episodes: int
    """Number of training episodes."""

    @classmethod
    def of(
        cls,
        train: EpisodeStore,
        liked_of: Callable[[EpisodeStore, Array], BoolArray] = liked_rewards,
    ) -> "TrainingCounts":
        """Count the items in `train`, a view of a store of items; `liked_of` as `liked_rewards`."""
        shown, liked = np.zeros((2, len(train.item_states.embeddings)), dtype=np.int64)
        for items, rewards in train.column_batches(schema.ITEM, schema.REWARD):
            shown += np.bincount(items, minlength=len(shown))
            liked += np.bincount(items[liked_of(train, rewards)], minlength=len(liked))
        return cls(torch.from_numpy(shown), torch.from_numpy(liked), train.n_episodes)

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically."""
        save_tensors(path, {"shown": self.shown, "liked": self.liked}, {"episodes": self.episodes})

    @classmethod
    def load(cls, path: Path) -> "TrainingCounts":
        """Read a file that `save` wrote.

        Raises:
            InputError: the file is missing or damaged.
        """
        tensors, numbers = load_tensors(path)
        with damage_explained(path, REMEDY):
            for name in ("shown", "liked"):
                if tensors[name].dtype != torch.int64 or bool((tensors[name] < 0).any()):
                    raise ValueError(f"{name} are not counts")
            return cls(tensors["shown"], tensors["liked"], int(numbers["episodes"]))
