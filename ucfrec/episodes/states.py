"""Item-embedding states: a vector that summarises a session just before step t.

Training windows and acting both call `ItemStates.build`. It uses only element-wise
operations in a fixed order, so its results are bit-identical for every batch size.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray
from ucfrec.episodes.item_table import DECAY, DISTINCT_TAGS, TAGS_PER_ITEM, WINDOW, write_item_table
from ucfrec.errors import InputError, damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors

if TYPE_CHECKING:
    from ucfrec.episodes.store import EpisodeStore


LIKED = 0.6
"""A step counts as liked if its reward, scaled to [0, 1] as in item states, is at least this: the
threshold on the normalised watch ratio in the published dominance metric; a click is liked."""
_HOUR_MS = 3_600_000
_Reward = TypeVar("_Reward", float, Tensor)


@dataclass(frozen=True)
class ItemStates:
    """Builds states from the items shown, their rewards and the features of the user.

    A state of size S = 3D + 2 + F + O holds, in this order: the recency-weighted mean embedding of
    the last `window` items shown (D), the same weighted by reward as well (D), the last item's
    embedding (D), the last reward scaled to [0, 1] (1), log(1 + step) (1), user features (F) and
    the logged observation (O). InputError if `reward_low` is not below `reward_high`.
    """

    embeddings: Tensor
    """(n_items, D)."""
    user_features: Tensor
    """(n_users, F), standardised; F is 0 if there are none."""
    reward_low: float
    """Rewards up to this one are scaled to 0."""
    reward_high: float
    """Rewards from this one on are scaled to 1."""
    window: int = WINDOW
    """Number of most recent steps that enter the means."""
    decay: float = DECAY
    """Factor by which the weight in the means falls with each step back."""
    tags: Tensor = field(default_factory=lambda: torch.zeros(0, 0, dtype=torch.int64))
    """(n_items, T) int64 numbers of each item's tags, padded with −1; T is 0 if the catalogue has
    none. States do not contain them: they show which items are alike."""

    def __post_init__(self) -> None:
        tables, tags = (self.embeddings, self.user_features), self.tags
        if any(table.dim() != 2 or not table.is_floating_point() for table in tables):
            raise InputError("embeddings and user features of item states must be real matrices")
        # Tags are numbered without gaps, so that no number exceeds their count.
        most = min(tags.numel(), DISTINCT_TAGS) - 1
        shaped = tags.dim() == 2 and (len(tags) == len(self.embeddings) or not tags.shape[1])
        numbered = not tags.numel() or -1 <= int(tags.min()) <= int(tags.max()) <= most
        narrow = shaped and tags.shape[1] <= TAGS_PER_ITEM
        if not (narrow and numbered and tags.dtype == torch.int64):
            raise InputError(
                f"tags of item states must be integers from -1 to {most}, one row per item, of at "
                f"most {TAGS_PER_ITEM}"
            )
        whole = type(self.window) is int and 1 <= self.window <= 10_000
        if not (whole and _is_real(self.decay) and 0 <= self.decay <= 1):
            raise InputError(
                f"item states have window {self.window!r:.60} and decay {self.decay!r:.60}; "
                "give 1 to 10,000 and 0 to 1"
            )
        low, high = self.reward_low, self.reward_high
        if not (_is_real(low) and _is_real(high) and low < high):
            raise InputError(
                f"rewards from {low!r:.60} to {high!r:.60} cannot be scaled to [0, 1]; "
                "reward_low must be below reward_high"
            )
        # Index −1 ("no item", "unknown user") selects a last row of zeros. Embeddings are the rows
        # before it, so that a large catalogue is in memory once.
        items = F.pad(self.embeddings.float(), (0, 0, 0, 1))
        object.__setattr__(self, "_items", items)
        object.__setattr__(self, "embeddings", items[:-1])
        object.__setattr__(self, "_users", F.pad(self.user_features.float(), (0, 0, 0, 1)))
        decays = [self.decay**lag for lag in reversed(range(self.window))]
        object.__setattr__(self, "_decays", torch.tensor(decays))

    @property
    def size(self) -> int:
        """Size of a state without an observation, 3D + 2 + F."""
        return 3 * self.embeddings.shape[1] + 2 + self.user_features.shape[1]

    def build(
        self,
        items: Tensor,
        rewards: Tensor,
        steps: Tensor,
        users: Tensor,
        observations: Tensor,
    ) -> Tensor:
        """States (B, K, S) just before K consecutive steps of each of B sessions.

        Args:
            items: (B, K + window − 1) int64 items shown before the last of the steps, the latest
                last, with their `rewards`; −1 before the session began.
            steps: (B, K) int64 number of each step in its session, from 0.
            users: (B,) int64 rows of `user_features`; −1 for an unknown user.
            observations: (B, K, O) observations logged with the steps; O may be 0.
        """
        table: Tensor = self._items  # type: ignore[attr-defined]
        batch, length = steps.shape
        scaled_rewards = (rewards - self.reward_low) / (self.reward_high - self.reward_low)
        valid = (items >= 0).float()
        # What an item counts, and what its reward makes it count.
        counts = torch.stack([valid, scaled_rewards.clamp(0, 1) * valid])
        embedded = table[items]
        # Another column of ones adds up the weights.
        padded = F.pad(embedded, (0, 1), value=1.0)
        sums = padded.new_zeros(2, batch, length, padded.shape[-1])
        weights = counts.unfold(2, self.window, 1) * self._decays  # type: ignore[attr-defined]
        vectors = padded.unfold(1, self.window, 1).unbind(-1)
        of_lags = weights.unsqueeze(-1).unbind(3), vectors
        # Floating-point sums depend on their order: the most recent item comes first.
        for weight, vector in reversed(list(zip(*of_lags, strict=True))):
            sums = sums.add_(weight * vector)
        means = sums[..., :-1] / sums[..., -1:].clamp(min=1e-6)
        return torch.cat(
            [
                means[0],
                means[1],
                embedded[:, self.window - 1 :],
                counts[1, :, self.window - 1 :].unsqueeze(-1),
                torch.log1p(steps.float()).unsqueeze(-1),
                self._users[users].unsqueeze(1).expand(-1, length, -1),  # type: ignore[attr-defined]
                observations,
            ],
            dim=-1,
        )

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically; see `write_item_table`."""
        write_item_table(
            path,
            self.embeddings.numpy(),
            self.user_features.numpy(),
            self.tags.numpy(),
            self.reward_low,
            self.reward_high,
            self.window,
            self.decay,
        )

    @classmethod
    def load(cls, path: Path) -> "ItemStates":
        """Read a file that `save` wrote; an InputError if it is missing or damaged."""
        tensors, numbers = load_tensors(path)
        with damage_explained(path, REMEDY):
            arguments: dict[str, Any] = {**tensors, **numbers}
            return cls(**arguments)


def _is_real(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def least_liked(low: _Reward, high: _Reward) -> _Reward:
    """The lowest reward of a liked step, where training rewards are from `low` to `high`."""
    return low + LIKED * (high - low)


def liked_rewards(store: "EpisodeStore", rewards: Array) -> BoolArray:
    """Whether steps (N,) of a store of items were liked: their reward is at least `least_liked`."""
    states = store.item_states
    return rewards >= least_liked(states.reward_low, states.reward_high)


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
        train: "EpisodeStore",
        liked_of: Callable[["EpisodeStore", Array], BoolArray] = liked_rewards,
        half_life: float = math.inf,
    ) -> "TrainingCounts":
        """Count the items in `train`, a view of a store of items; `liked_of` as `liked_rewards`.

        Steps halve with every half-life (hours) of their age, float64, unless it is infinite or the
        store has no times.
        """
        names, n_items = [schema.ITEM, schema.REWARD], len(train.item_states.embeddings)
        timed = schema.TIMESTAMP in train.record.columns and math.isfinite(half_life)
        shown, liked = np.zeros((2, n_items))
        if timed:
            names.append(schema.TIMESTAMP)
            last = int(train.column(schema.TIMESTAMP).max())
        for items, rewards, *times in train.column_batches(*names):
            ages = last - times[0] if timed else np.zeros(len(items))
            weights = np.exp2(-ages / (half_life * _HOUR_MS))
            shown += np.bincount(items, weights, n_items)
            liked += np.bincount(items, weights * liked_of(train, rewards), n_items)
        counts = torch.from_numpy(np.stack([shown, liked])).to(
            torch.float64 if timed else torch.int64
        )
        return cls(counts[0], counts[1], train.n_episodes)

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically."""
        save_tensors(path, {"shown": self.shown, "liked": self.liked}, {"episodes": self.episodes})

    @classmethod
    def load(cls, path: Path) -> "TrainingCounts":
        """Read a file that `save` wrote; an InputError if it is missing or damaged."""
        tensors, numbers = load_tensors(path)
        with damage_explained(path, REMEDY):
            for name in ("shown", "liked"):
                if tensors[name].dtype != torch.int64 or bool((tensors[name] < 0).any()):
                    raise ValueError(f"{name} are not counts")
            return cls(tensors["shown"], tensors["liked"], int(numbers["episodes"]))
