"""Main tags of items, and fatigue: users reward less once they liked one many times in a row."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec import schema
from ucfrec.arrays import BoolArray, IntArray
from ucfrec.episodes.states import ItemStates, least_liked
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown

LONGEST = 8
"""Largest length of a run, and largest number of steps that it lasts, that are tried."""
_MOST = 0.5
"""Largest factor that counts as fatigue."""
_EXPECTED = 20.0
"""Fewest rewards to be expected of users without fatigue, from which a factor is estimated."""


@dataclass(frozen=True)
class MainTags:
    """The tag whose items' embeddings each item's resembles most, and what counts as liked."""

    tags: Tensor
    """(n_items,) int64; −1 for items without tags."""
    reward_low: float
    reward_high: float

    @classmethod
    def of(cls, states: ItemStates) -> "MainTags":
        """The main tags of a store's items."""
        tags, low, high = states.tags, states.reward_low, states.reward_high
        if not tags.shape[1]:
            return cls(torch.full((len(states.embeddings),), -1), low, high)
        directions = F.normalize(states.embeddings.double(), dim=1)
        n_tags = int(tags.max()) + 1
        places = torch.where(tags < 0, n_tags, tags)
        sums = directions.new_zeros(n_tags + 1, directions.shape[1])
        for column in places.unbind(1):
            sums.index_add_(0, column, directions)
        centres = F.normalize(sums, dim=1)
        columns = [(centres[column] * directions).sum(1) for column in places.unbind(1)]
        typical = torch.stack(columns, 1).masked_fill(tags < 0, -torch.inf)
        return cls(tags.gather(1, typical.argmax(1, keepdim=True))[:, 0], low, high)

    def liked(self, rewards: Tensor) -> Tensor:
        """Whether the items with the rewards (...) were liked."""
        return rewards >= least_liked(self.reward_low, self.reward_high)

    def runs(self, history: Shown) -> Tensor:
        """In how many steps in a row, up to each earlier one, one main tag was liked, (B, N); 0
        where the item was not liked, has no tags, or none was shown."""
        liked = self.liked(history.rewards) & (history.items >= 0)
        tags = torch.where(liked, self.tags[history.items], -1)
        lengths = []
        previous = torch.full((len(tags),), -1)
        length = torch.zeros(len(tags), dtype=torch.int64)
        for tag in reversed(tags.unbind(1)):
            length = (torch.where(tag == previous, length, 0) + 1).masked_fill(tag < 0, 0)
            previous = tag
            lengths.append(length)
        return torch.stack(lengths[::-1], 1) if lengths else torch.zeros_like(history.items)

    def find_tired(self, history: Shown, run: int) -> Tensor:
        """Main tag (B,) of the `run` items shown last, if all had it and were liked; else −1."""
        items, rewards = (values[:, :run] for values in history)
        tags = self.tags[items.clamp(min=0)]
        alike = (tags == tags[:, :1]) & (items >= 0) & self.liked(rewards)
        return torch.where(alike.all(1) & (items.shape[1] >= run), tags[:, 0], -1)


@dataclass(frozen=True)
class Fatigue:
    """After `length` liked items of one main tag in a row, the probability of a reward is
    multiplied by `factor` for `steps` steps."""

    length: int
    steps: int
    factor: float

    def is_tired(self, runs: Tensor) -> Tensor:
        """Whether users are fatigued, (M,) bool, from `MainTags.runs` (M, N) before a step."""
        return (runs[:, : self.steps] >= self.length).any(1)


@dataclass(frozen=True)
class LoggedRuns:
    """M logged steps: what users liked in a row before them, and whether they liked the item."""

    runs: Tensor
    """(M, N) of `MainTags.runs`; nothing of the step itself or of later ones."""
    liked: BoolArray
    sessions: IntArray

    @classmethod
    def of(
        cls,
        store: EpisodeStore,
        tags: MainTags,
        lags: int,
        most: int,
    ) -> "LoggedRuns":
        """Steps of a view of a store of items: the first sessions of it, about `most` steps."""
        ends = np.cumsum(store.lengths)
        view = store.select(np.arange(int(np.searchsorted(ends, most)) + 1)[: len(ends)])
        episodes, steps = view.all_steps()
        runs = tags.runs(Shown.before(view, episodes, steps, lags))
        rewards = torch.from_numpy(view.step_values(schema.REWARD, episodes, steps))
        return cls(runs, tags.liked(rewards).numpy(), episodes)

    def count_likes(self, fatigue: Fatigue) -> tuple[float, float]:
        """Likes of fatigued users, and as many as they gave elsewhere in the same sessions."""
        tired = fatigue.is_tired(self.runs).numpy()
        count = int(self.sessions.max(initial=-1)) + 1
        rested = np.bincount(self.sessions[~tired], minlength=count)
        liked = np.bincount(self.sessions[~tired & self.liked], minlength=count)
        share = liked / np.maximum(rested, 1)
        return float(self.liked[tired].sum()), float(share[self.sessions[tired]].sum())


def fit_fatigue(training: LoggedRuns, held_out: LoggedRuns) -> Fatigue | None:
    """The fatigue that training rows show most clearly; None if there is none. The factor is the
    share of likes with fatigued users relative to that in the rest of the same sessions: of
    policies that knew of the fatigue, too little. It is at most a half, held out too."""
    best, clearest, remembered = None, 0.0, training.runs.shape[1]
    for length in range(2, min(LONGEST, remembered) + 1):
        for steps in range(1, min(LONGEST, remembered - length + 1) + 1):
            likes, expected = training.count_likes(Fatigue(length, steps, 0.0))
            if expected < _EXPECTED or likes > _MOST * expected:
                continue
            # Twice the logarithm of the likelihood ratio of two Poisson rates.
            clearness = 2 * (likes * np.log(max(likes, 1e-9) / expected) + expected - likes)
            if clearness > clearest:
                best = Fatigue(length, steps, likes / expected)
                clearest = clearness
    if best is None:
        return None
    likes, expected = held_out.count_likes(best)
    return best if expected >= _EXPECTED and likes <= _MOST * expected else None
