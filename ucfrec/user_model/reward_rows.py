"""The logged steps that the reward model of items is fitted to and evaluated on."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ucfrec import schema
from ucfrec.arrays import IntArray
from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.store import EpisodeStore

_CHUNK = 65_536


@dataclass(frozen=True)
class RewardRows:
    """M logged steps: what was shown to whom, after what, and the reward."""

    items: Tensor
    """(M,) int64."""
    users: Tensor
    """(M,) int64 numbers in the store; −1 if the store does not name its users."""
    shown: Shown
    """The items shown earlier in the session, (M, lags)."""
    states: Tensor
    """(M, S) float32 states before the step."""
    rewards: Tensor
    """(M,) float32, in reward units."""
    observations: int
    """O, the last numbers of the states: what was observed beside the session itself."""

    def __len__(self) -> int:
        return len(self.items)

    @classmethod
    def of(cls, view: EpisodeStore, lags: int, limit: int, seed: int) -> "RewardRows":
        """All steps of a view of a store of items; of more than `limit`, so many drawn by `seed`.

        Of what was shown earlier, the latest `lags` steps are read. Nothing of a step but its item
        and reward is read, nor anything of later steps.
        """
        return cls.at(view, *drawn_steps(view, limit, seed), lags)

    @classmethod
    def at(cls, view: EpisodeStore, episodes: IntArray, steps: IntArray, lags: int) -> "RewardRows":
        """The given steps (M,) of a view."""
        states = torch.empty(len(steps), view.state_size)
        for start in range(0, len(steps), _CHUNK):
            part = slice(start, start + _CHUNK)
            states[part] = view.windows(episodes[part], steps[part], 1).states[:, 0]
        return cls(
            torch.from_numpy(view.step_values(schema.ITEM, episodes, steps).astype(np.int64)),
            torch.from_numpy(_users(view)[episodes]),
            _shown(view, episodes, steps, lags),
            states,
            torch.from_numpy(view.step_values(schema.REWARD, episodes, steps)),
            view.observation_size,
        )


def drawn_steps(view: EpisodeStore, limit: int, seed: int) -> tuple[IntArray, IntArray]:
    """Episodes and steps (M,) of all steps of a view; of more than `limit`, so many drawn."""
    numbers = np.arange(view.n_steps)
    if view.n_steps > limit:
        drawn = np.random.default_rng(seed).choice(view.n_steps, limit, replace=False)
        numbers = np.sort(drawn)
    return view.locate(numbers)


def _shown(view: EpisodeStore, episodes: IntArray, steps: IntArray, lags: int) -> Shown:
    earlier = steps[:, None] - np.arange(1, lags + 1)
    at = (episodes[:, None], np.maximum(earlier, 0))
    items = np.where(earlier >= 0, view.step_values(schema.ITEM, *at), -1).astype(np.int64)
    rewards = np.where(earlier >= 0, view.step_values(schema.REWARD, *at), 0).astype(np.float32)
    return Shown(torch.from_numpy(items), torch.from_numpy(rewards))


def _users(view: EpisodeStore) -> IntArray:
    if not view.has_users:
        return np.full(view.n_episodes, -1)
    return view.episode_values(schema.USER).astype(np.int64)
