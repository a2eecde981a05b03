"""What is gathered from a store: windows, single steps, and the edited copies of episodes."""

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec.errors import InputError
from ucfrec.fitting.checkpoint import load_tensors, save_tensors

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Windows:
    """B windows of K steps, padded on the left; padding is zero and `mask` is false there.

    Raises:
        InputError: the shapes do not go together.
    """

    states: Tensor
    """(B, K, S) float32."""
    actions: Tensor
    """(B, K, A) float32 vectors, or (B, K) int64 items."""
    rewards: Tensor
    """(B, K)."""
    returns_to_go: Tensor
    """(B, K) undiscounted Ĝ_t."""
    timesteps: Tensor
    """(B, K) int64, number of the step in its episode, from 0."""
    mask: Tensor
    """(B, K) bool, true at steps of the episode."""

    def __post_init__(self) -> None:
        shape = self.mask.shape
        if not (
            len(shape) == 2
            and shape == self.rewards.shape == self.returns_to_go.shape == self.timesteps.shape
            and (self.states.ndim, self.states.shape[:2]) == (3, shape)
            and (self.actions.ndim in (2, 3) and self.actions.shape[:2] == shape)
        ):
            raise _shapes_differ(self, "(B, K), states (B, K, S), actions (B, K) or (B, K, A)")

    def __repr__(self) -> str:
        (windows, steps, size), items = self.states.shape, self.actions.ndim == 2
        actions = "items" if items else f"vectors of {self.actions.shape[2]}"
        return f"Windows({windows:,} of {steps} steps, states of {size}, actions are {actions})"

    def to(self, device: torch.device) -> "Windows":
        """The same windows on `device`."""
        moved = {f.name: getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)}
        return Windows(**moved)


@dataclass(frozen=True)
class Transitions:
    """M single steps, aligned.

    Raises:
        InputError: the shapes do not go together.
    """

    states: Tensor
    """(M, S)."""
    actions: Tensor
    """(M, A); an item stands as its embedding."""
    rewards: Tensor
    """(M,)."""
    next_states: Tensor
    """(M, S) factual successors, never edited; zeros at the last step of an episode."""
    last: Tensor
    """(M,) bool, true at the last step of an episode."""

    def __post_init__(self) -> None:
        shape = self.rewards.shape
        if not (
            len(shape) == 1
            and shape == self.last.shape == self.states.shape[:1] == self.actions.shape[:1]
            and self.states.ndim == self.actions.ndim == 2
            and self.states.shape == self.next_states.shape
        ):
            raise _shapes_differ(self, "(M,), states and next_states (M, S), actions (M, A)")

    def __repr__(self) -> str:
        (steps, size), action = self.states.shape, self.actions.shape[1]
        return f"Transitions({steps:,} steps, states of {size}, actions of {action})"


@dataclass(frozen=True)
class Overlay:
    """Edited copies of episodes: only what differs from the source is held.

    Rewards, actions, returns-to-go and next states of a copy are its source's (Appendix H).

    Raises:
        InputError: the shapes do not go together.
    """

    copy_source: IntArray
    """(C,) number in the store of the episode that each copy was made of."""
    edit_copy: IntArray
    """(M,) copy, 0 to C − 1, that each edit belongs to."""
    edit_step: IntArray
    """(M,) step of the episode that is edited; (copy, step) strictly increases."""
    edit_state: FloatArray
    """(M, S) the counterfactual state."""

    def __post_init__(self) -> None:
        shape = self.edit_copy.shape
        if not (
            len(shape) == self.copy_source.ndim == 1
            and shape == self.edit_step.shape == self.edit_state.shape[:1]
            and self.edit_state.ndim == 2
        ):
            raise _shapes_differ(self, "copy_source (C,), edits (M,), edit_state (M, S)")

    def __repr__(self) -> str:
        edits, size = self.edit_state.shape
        return f"Overlay({len(self.copy_source):,} copies, {edits:,} edited states of {size})"

    def edits_at(self, copies: IntArray, steps: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Which of the steps asked for are edited.

        Args:
            copies: (B, 1) copies; below 0 for an episode that is none.
            steps: (B, K) steps of those copies; below 0 before the episode's first.

        Returns:
            Rows and columns of `steps` that are edited, and the numbers of their edits.
        """
        keys, stride = self._keys
        inside = (copies >= 0) & (steps >= 0) & (steps < stride)
        wanted = np.where(inside, copies * stride + steps, -1)
        found = np.searchsorted(keys, wanted)
        rows, columns = np.nonzero(keys[found] == wanted)
        return rows, columns, found[rows, columns]

    @cached_property
    def _keys(self) -> tuple[IntArray, int]:
        """(M + 1,) one increasing number an edit, and one at the end that nothing reaches; and the
        distance between the first steps of two copies."""
        stride = int(self.edit_step.max(initial=0)) + 1
        keys = self.edit_copy * stride + self.edit_step
        return np.append(keys, np.iinfo(np.int64).max), stride

    def joined(self, other: "Overlay") -> "Overlay":
        """The copies of this overlay, and after them those of `other`."""
        after = Overlay(
            other.copy_source,
            other.edit_copy + len(self.copy_source),
            other.edit_step,
            other.edit_state,
        )
        pairs = ((getattr(self, f.name), getattr(after, f.name)) for f in fields(self))
        return Overlay(*(np.concatenate(pair) for pair in pairs))

    def save(self, path: Path) -> None:
        """Write to one safetensors file."""
        arrays = {f.name: torch.from_numpy(getattr(self, f.name)) for f in fields(self)}
        save_tensors(path, arrays, {})

    @classmethod
    def load(cls, path: Path) -> "Overlay":
        """Read what `save` wrote."""
        tensors, _ = load_tensors(path)
        return cls(**{name: tensor.numpy() for name, tensor in tensors.items()})


def _shapes_differ(value: Windows | Transitions | Overlay, wanted: str) -> InputError:
    shapes = ", ".join(f"{f.name} {tuple(getattr(value, f.name).shape)}" for f in fields(value))
    return InputError(
        f"{type(value).__name__}: shapes do not go together ({shapes}); give {wanted}"
    )
