"""Batches gathered from a store (windows, transitions) and overlays of copies."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.errors import damage_explained
from ucfrec.fitting.checkpoint import REMEDY, load_tensors, save_tensors


@dataclass(frozen=True)
class Windows:
    """B windows of K steps, padded on the left; at padding all values are 0 and `mask` is false."""

    states: Tensor
    """(B, K, S) float32."""
    actions: Tensor
    """(B, K, A) float32 vectors, or (B, K) int64 items."""
    rewards: Tensor
    """(B, K) float32, in reward units."""
    returns_to_go: Tensor
    """(B, K) float32 undiscounted Ĝ_t, in reward units."""
    timesteps: Tensor
    """(B, K) int64 number of the step in its episode, from 0."""
    mask: Tensor
    """(B, K) bool, true at steps of the episode, false at padding."""

    def __repr__(self) -> str:
        (windows, steps, size), items = self.states.shape, self.actions.ndim == 2
        actions = "items" if items else f"vectors of {self.actions.shape[2]}"
        return f"Windows({windows:,} of {steps} steps, states of {size}, actions are {actions})"

    @classmethod
    def of(
        cls,
        numbers: Tensor,
        states: Tensor,
        actions: Tensor,
        rewards: Tensor,
        returns_to_go: Tensor | None = None,
    ) -> "Windows":
        """Windows of the given steps; what they have at padding becomes 0.

        Args:
            numbers: (B, K) int64 number of each step in its episode; below 0 at padding.
            states: (B, K, S).
            actions: (B, K, A) vectors or (B, K) items.
            rewards: (B, K).
            returns_to_go: (B, K); None for zeros, where a decision sets them.
        """
        mask = numbers >= 0
        padding = ~mask

        def kept(values: Tensor) -> Tensor:
            return values.masked_fill(padding if values.ndim == 2 else padding.unsqueeze(-1), 0)

        return cls(
            kept(states),
            kept(actions),
            kept(rewards),
            torch.zeros_like(rewards) if returns_to_go is None else kept(returns_to_go),
            numbers.clamp(min=0),
            mask,
        )

    @classmethod
    def joined(cls, parts: Sequence["Windows"]) -> "Windows":
        """The windows of all parts, one part after the other."""
        names = [f.name for f in fields(cls)]
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in names))

    def at(self, rows: slice | Tensor) -> "Windows":
        """The windows with the given numbers."""
        return Windows(*(getattr(self, f.name)[rows] for f in fields(self)))

    def last(self, steps: int) -> "Windows":
        """The windows of this number of last steps."""
        return Windows(**{f.name: getattr(self, f.name)[:, -steps:] for f in fields(self)})

    def to(self, device: torch.device) -> "Windows":
        """A copy of the windows on `device`."""
        moved = {f.name: getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)}
        return Windows(**moved)


@dataclass(frozen=True)
class Transitions:
    """M single steps."""

    states: Tensor
    """(M, S)."""
    actions: Tensor
    """(M, A) vectors; an item is represented by its embedding."""
    rewards: Tensor
    """(M,), in reward units."""
    next_states: Tensor
    """(M, S) next states as logged, never edited; zeros at the last step of an episode."""
    last: Tensor
    """(M,) bool, true at the last step of an episode."""

    def to(self, device: torch.device) -> "Transitions":
        """The steps on `device`."""
        return Transitions(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def __repr__(self) -> str:
        (steps, size), action = self.states.shape, self.actions.shape[1]
        return f"Transitions({steps:,} steps, states of {size}, actions of {action})"


def _no_integers() -> IntArray:
    return np.zeros(0, dtype=np.int64)


def _no_floats() -> Float32Array:
    return np.zeros(0, dtype=np.float32)


@dataclass(frozen=True)
class Overlay:
    """Counterfactual copies of episodes, stored as what differs from their sources.

    C copies have other states at some steps: rewards, actions, returns-to-go and next states are
    those of the source (paper appendix H). N action copies end with another action: the source up
    to some step, at which another action had another reward.
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
    action_reward: Float32Array = field(default_factory=_no_floats)
    """(N,) their rewards, in reward units."""

    def __repr__(self) -> str:
        edits, size = self.edit_state.shape
        facts = f"{len(self.copy_source):,} copies, {edits:,} edited states of {size}"
        if len(self.action_source):
            facts += f", {len(self.action_source):,} action copies"
        return f"Overlay({facts})"

    @classmethod
    def of_actions(
        cls, source: IntArray, step: IntArray, action: Array, reward: Float32Array, state_size: int
    ) -> "Overlay":
        """An overlay of action copies only, of a store whose states have `state_size` numbers."""
        nothing = np.zeros(0, dtype=np.int64)
        states = np.zeros((0, state_size), dtype=np.float32)
        return cls(nothing, nothing, nothing, states, source, step, action, reward)

    def edits_at(self, copies: IntArray, steps: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Find which of the given steps are edited.

        Args:
            copies: (B, 1) numbers of copies; below 0 for an episode that is not a copy.
            steps: (B, K) steps of those copies; below 0 at padding.

        Returns:
            For each edited step, its row and column in `steps` and the number of its edit, 0 to
            M − 1; three arrays of the same length.
        """
        keys, stride = self._keys
        possible = (copies >= 0) & (steps >= 0) & (steps < stride)
        step_keys = np.where(possible, copies * stride + steps, -1)
        positions = np.searchsorted(keys, step_keys)
        rows, columns = np.nonzero(keys[positions] == step_keys)
        return rows, columns, positions[rows, columns]

    @cached_property
    def _keys(self) -> tuple[IntArray, int]:
        """(M + 1,) increasing keys copy × stride + step of the edits, and the stride.

        The last key is a sentinel, larger than any other, so that every search ends inside.
        """
        stride = int(self.edit_step.max(initial=0)) + 1
        keys = self.edit_copy * stride + self.edit_step
        return np.append(keys, np.iinfo(np.int64).max), stride

    def joined(self, other: "Overlay") -> "Overlay":
        """An overlay with the copies of this one, followed by those of `other`."""
        renumbered = replace(other, edit_copy=other.edit_copy + len(self.copy_source))
        pairs = ((getattr(self, f.name), getattr(renumbered, f.name)) for f in fields(self))
        return Overlay(*(_end_to_end(*pair) for pair in pairs))

    def save(self, path: Path) -> None:
        """Write to one safetensors file, atomically."""
        arrays = {f.name: torch.from_numpy(getattr(self, f.name)) for f in fields(self)}
        save_tensors(path, arrays, {})

    @classmethod
    def load(cls, path: Path) -> "Overlay":
        """Read a file that `save` wrote.

        Raises:
            InputError: the file is missing or damaged.
        """
        tensors, _ = load_tensors(path)
        with damage_explained(path, REMEDY):
            overlay = cls(**{name: tensor.numpy() for name, tensor in tensors.items()})
            overlay._require_consistent()
        return overlay

    def _require_consistent(self) -> None:
        """Raise ValueError for arrays whose types, shapes or numbers of copies do not agree."""
        numbers = (
            *(self.copy_source, self.edit_copy, self.edit_step),
            *(self.action_source, self.action_step),
        )
        if not all(values.dtype == np.int64 and values.ndim == 1 for values in numbers):
            raise ValueError("its episodes, copies and steps are not lists of int64")
        edits, copies = len(self.edit_copy), len(self.action_source)
        if self.edit_state.ndim != 2 or {len(self.edit_step), len(self.edit_state)} != {edits}:
            raise ValueError("its edits differ in number")
        if self.action_reward.shape != (copies,) or {
            len(self.action_step), len(self.action)
        } != {copies}:  # fmt: skip
            raise ValueError("its action copies differ in number")
        if edits and not 0 <= self.edit_copy.min() <= self.edit_copy.max() < len(self.copy_source):
            raise ValueError("an edit is of a copy that it does not have")


def _end_to_end(first: Array, second: Array) -> Array:
    # Without action copies, an overlay does not know the size of an action.
    return (
        np.concatenate([first, second])
        if len(first) and len(second)
        else max(first, second, key=len)
    )
