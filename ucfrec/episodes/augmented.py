"""Augmented episodes: what differs from the logged ones, and training windows of both."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ucfrec import schema
from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Windows
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import load_tensors, save_tensors

AUGMENTED: Final = "augmented.safetensors"
"""Name of the file in a run."""


def _no_integers() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class AugmentedEpisodes:
    """Counterfactual episodes of a store, kept as what differs from the logged ones.

    C copies have other states at some steps: rewards, actions, returns-to-go and next states are
    those of the source (paper appendix H). N action copies end with another action: the source up
    to some step, at which another action had another reward. Kept whole, the states of a copy
    would take S times the memory of its log, and an action copy K states for its one step.
    """

    copy_source: IntArray
    """(C,) number in the store of the episode that was copied."""
    edit_copy: IntArray
    """(M,) number of the copy, 0 to C − 1, that each edit belongs to."""
    edit_step: IntArray
    """(M,) step of the episode that each edit changes; (copy, step) is strictly increasing."""
    edit_state: Float32Array
    """(M, S) counterfactual states."""
    action_source: IntArray = field(default_factory=_no_integers)
    """(N,) number in the store of the episode that an action copy is of."""
    action_step: IntArray = field(default_factory=_no_integers)
    """(N,) step of the episode with the other action, the last of the copy."""
    action: Array = field(default_factory=_no_integers)
    """(N,) int64 items or (N, A) float32 vectors: the other actions."""
    action_reward: Float32Array = field(default_factory=lambda: np.zeros(0, dtype=np.float32))
    """(N,) their rewards, in reward units."""

    def __repr__(self) -> str:
        edits, size = self.edit_state.shape
        return (
            f"AugmentedEpisodes({len(self.copy_source):,} copies, {edits:,} edited states of "
            f"{size}, {len(self.action_source):,} action copies)"
        )

    def join(self, other: "AugmentedEpisodes") -> "AugmentedEpisodes":
        """These episodes, followed by those of `other`."""
        renumbered = replace(other, edit_copy=other.edit_copy + len(self.copy_source))
        values = {}
        for name in (column.name for column in fields(self)):
            parts = [getattr(self, name), getattr(renumbered, name)]
            # Without action copies, the size of an action is not known.
            values[name] = np.concatenate([part for part in parts if len(part)] or parts[:1])
        return AugmentedEpisodes(**values)

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically."""
        arrays = {f.name: torch.from_numpy(getattr(self, f.name)) for f in fields(self)}
        save_tensors(path, arrays, {})

    @classmethod
    def load(cls, path: Path, store: EpisodeStore) -> "AugmentedEpisodes":
        """Read a file that `save` wrote, of episodes of `store` or the store that it is a view of.

        Raises:
            InputError: the file is missing or damaged, or the episodes are of another store.
        """
        tensors, _ = load_tensors(path)
        with damage_explained(path, f"train again with {store.path}, or the store it was made of"):
            episodes = cls(**{name: tensor.numpy() for name, tensor in tensors.items()})
            episodes._require_of(store)
        return episodes

    def _require_of(self, store: EpisodeStore) -> None:
        """Raise ValueError for arrays whose types, shapes and numbers are not of one store."""
        numbers = {
            **{"copy_source": self.copy_source, "edit_copy": self.edit_copy},
            **{"edit_step": self.edit_step, "action_source": self.action_source},
            "action_step": self.action_step,
        }
        for name, values in numbers.items():
            if values.dtype != np.int64 or values.ndim != 1:
                raise ValueError(f"{name} is no list of int64")
        edits, copies = len(self.edit_copy), len(self.action_source)
        if len(self.edit_step) != edits or self.edit_state.shape != (edits, store.state_size):
            raise ValueError("its edits differ in number, or its states in size")
        if len(self.action_step) != copies or self.action_reward.shape != (copies,):
            raise ValueError("its action copies differ in number")
        if {self.edit_state.dtype, self.action_reward.dtype} != {np.dtype(np.float32)}:
            raise ValueError("its states or rewards are not float32")
        _require_below(self.copy_source, store.record.n_episodes, "an episode")
        _require_below(self.action_source, store.record.n_episodes, "an episode")
        _require_below(self.edit_copy, len(self.copy_source), "a copy")
        lengths = store.whole.lengths
        _require_below(self.edit_step, lengths[self.copy_source[self.edit_copy]], "a step")
        _require_below(self.action_step, lengths[self.action_source], "a step")
        shape = () if store.has_items else tuple(store.record.columns[schema.ACTION])
        kind = np.int64 if store.has_items else np.float32
        if copies and (self.action.dtype != kind or self.action.shape != (copies, *shape)):
            raise ValueError("its actions have another type or size")
        if store.has_items:
            _require_below(self.action, len(store.item_states.embeddings), "an item")


def _require_below(numbers: Array, ends: IntArray | int, what: str) -> None:
    if ((numbers < 0) | (numbers >= ends)).any():
        raise ValueError(f"it names {what} that there is not")


class TrainingEpisodes:
    """E logged episodes, then C augmented ones with other states, then N action copies.

    Only the last step of an action copy is drawn: those before it are its source's.
    """

    def __init__(self, logged: EpisodeStore, augmented: AugmentedEpisodes) -> None:
        self._augmented, self._n_logged = augmented, logged.n_episodes
        self._sources = logged.whole.select(
            np.concatenate([logged.episode_ids, augmented.copy_source, augmented.action_source])
        )
        self._first_action_copy = self._n_logged + len(augmented.copy_source)
        lengths, counts = self._sources.lengths.copy(), self._sources.lengths.copy()
        lengths[self._first_action_copy :] = augmented.action_step + 1
        counts[self._first_action_copy :] = 1
        self._ends = np.cumsum(counts)
        # The step at which an episode ends, less the number of its last drawn step.
        self._begins = self._ends - lengths
        self._stride = int(augmented.edit_step.max(initial=0)) + 1
        keys = augmented.edit_copy * self._stride + augmented.edit_step
        # A sentinel, so that every search ends inside.
        self._keys = np.append(keys, np.iinfo(np.int64).max)

    @property
    def n_steps(self) -> int:
        """Number of steps that are drawn."""
        return int(self._ends[-1])

    def draw_steps(self, generator: np.random.Generator, count: int) -> tuple[IntArray, IntArray]:
        """(episodes, steps), each (count,): steps drawn uniformly, with replacement."""
        numbers = generator.integers(self.n_steps, size=count)
        episodes = np.searchsorted(self._ends, numbers, side="right")
        return episodes, numbers - self._begins[episodes]

    def windows(self, episodes: IntArray, ends: IntArray, length: int) -> Windows:
        """Windows as `EpisodeStore.windows`; those of action copies end with their last step."""
        windows, augmented = self._sources.windows(episodes, ends, length), self._augmented
        steps = ends[:, None] + np.arange(1 - length, 1)
        copies = episodes[:, None] - self._n_logged
        possible = (copies >= 0) & (steps >= 0) & (steps < self._stride)
        keys = np.where(possible, copies * self._stride + steps, -1)
        places = np.searchsorted(self._keys, keys)
        edited = np.nonzero(self._keys[places] == keys)
        windows.states[edited] = torch.from_numpy(augmented.edit_state[places[edited]])
        rows = np.flatnonzero(episodes >= self._first_action_copy)
        if len(rows):
            numbers = episodes[rows] - self._first_action_copy
            rewards = torch.from_numpy(augmented.action_reward[numbers])
            change = rewards.double() - windows.rewards[rows, -1].double()
            ahead = np.arange(length - 1, -1, -1)
            weights = torch.from_numpy(self._sources.return_to_go.weights(ahead))
            added = weights * change.unsqueeze(1) * windows.mask[rows]
            windows.returns_to_go[rows] = (windows.returns_to_go[rows].double() + added).float()
            windows.actions[rows, -1] = torch.from_numpy(augmented.action[numbers])
            windows.rewards[rows, -1] = rewards
        return windows
