"""What is gathered from a store: windows, single steps, and the edits laid over it."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ucfrec.fitting.checkpoint import load_tensors, save_tensors

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Windows:
    """B windows of K steps, padded on the left; padding is zero and `mask` is false there."""

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

    def to(self, device: torch.device) -> "Windows":
        """The same windows on `device`."""
        moved = {f.name: getattr(self, f.name).to(device, non_blocking=True) for f in fields(self)}
        return Windows(**moved)


@dataclass(frozen=True)
class Transitions:
    """M single steps, aligned."""

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


@dataclass(frozen=True)
class Overlay:
    """Edited copies of episodes: only what differs from the base is held.

    Rewards, actions, returns-to-go and next states of a copy are its source's (Appendix H).
    """

    copy_source: IntArray
    """(C,) number of the base episode that each copy was made of."""
    edit_copy: IntArray
    """(M,) copy, 0 to C − 1, that each edit belongs to."""
    edit_step: IntArray
    """(M,) step of the episode that is edited; (copy, step) strictly increases."""
    edit_state: FloatArray
    """(M, S) the counterfactual state."""

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
