"""Batches gathered from a store: windows and transitions."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor


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
    """(M, S) next states as logged; zeros at the last step of an episode."""
    last: Tensor
    """(M,) bool, true at the last step of an episode."""

    def to(self, device: torch.device) -> "Transitions":
        """The steps on `device`."""
        return Transitions(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def __repr__(self) -> str:
        (steps, size), action = self.states.shape, self.actions.shape[1]
        return f"Transitions({steps:,} steps, states of {size}, actions of {action})"
