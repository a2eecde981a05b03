"""How often the training log shows each item, and how often it was liked."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore
from ucfrec.fitting.checkpoint import load_tensors, save_tensors

_LIKED = 0.6
"""Liking, the reward scaled to [0, 1] as in item states, from which a step counts as positive: the
normalised watch ratio of the published dominance; a click counts too."""


@dataclass(frozen=True)
class TrainingCounts:
    """Counts in the training log, which novelty and dominance use; items in the store's order."""

    shown: Tensor
    """(n_items,) int64 training steps of each item."""
    liked: Tensor
    """(n_items,) int64 those of them that were positive."""
    episodes: int
    """Training episodes."""

    @classmethod
    def of(cls, train: EpisodeStore) -> "TrainingCounts":
        """Count the steps of a view of a store of items."""
        states, steps = train.item_states, train.all_steps()
        items = torch.from_numpy(train.step_values(schema.ITEM, *steps)).long()
        rewards = torch.from_numpy(train.step_values(schema.REWARD, *steps))
        liking = (rewards - states.reward_low) / (states.reward_high - states.reward_low)
        n = len(states.embeddings)
        liked = torch.bincount(items[liking >= _LIKED], minlength=n)
        return cls(torch.bincount(items, minlength=n), liked, train.n_episodes)

    def save(self, path: Path) -> None:
        """Write to one safetensors file."""
        save_tensors(path, {"shown": self.shown, "liked": self.liked}, {"episodes": self.episodes})

    @classmethod
    def load(cls, path: Path) -> "TrainingCounts":
        """Read what `save` wrote."""
        tensors, numbers = load_tensors(path)
        return cls(tensors["shown"], tensors["liked"], int(numbers["episodes"]))
