"""Statistics of the accepted edits: their lengths and their variety."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Float64Array
from ucfrec.files.record import Undefinable

_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_BINS = 20


@dataclass(frozen=True)
class MoveReport:
    """Moves Δ = (s_c − s) / σ_s of the accepted edits (paper appendix I.2)."""

    edits: int
    """Number of accepted edits."""
    length_quantiles: dict[str, float]
    """Quantiles of ‖Δ‖₂ by level; empty without edits."""
    histogram_edges: tuple[float, ...]
    """Edges of the bins of ‖Δ‖₂, from 0 to ρ_high."""
    histogram_counts: tuple[int, ...]
    """Number of edits in each bin."""
    mean_move_ratio: Undefinable
    """‖mean Δ‖ / mean ‖Δ‖: 1 if all edits are the same shift, near 0 if they are varied."""
    effective_rank: float
    """exp of the entropy of the spectrum of E[ΔΔᵀ]: effective number of directions of the moves."""
    dimensions: int
    """Number of state dimensions that vary in the training data; bounds the effective rank."""


class MoveStatistics:
    """Accumulates statistics of moves chunk by chunk, without keeping the moves."""

    def __init__(self, size: int) -> None:
        """
        Args:
            size: S, dimensions of a move.
        """
        self._total = torch.zeros(size, dtype=torch.float64)
        self._moments = torch.zeros(size, size, dtype=torch.float64)
        self._lengths: list[Tensor] = []

    def add(self, moves: Tensor) -> None:
        """Add the moves Δ (M, S) of M accepted edits."""
        moves = moves.double()
        self._total += moves.sum(dim=0)
        self._moments += moves.T @ moves
        self._lengths.append(moves.norm(dim=1))

    def report(self, rho_high: float, dimensions: int) -> MoveReport:
        """Summarise the moves added so far; if none has a length, ratio is NaN and rank 0.

        Args:
            rho_high: upper end of the histogram of lengths.
            dimensions: number of state dimensions that vary.
        """
        lengths = torch.cat([torch.zeros(0, dtype=torch.float64), *self._lengths]).numpy()
        counts, edges = np.histogram(lengths, bins=_BINS, range=(0.0, rho_high))
        moved = bool(lengths.sum() > 0)
        return MoveReport(
            edits=len(lengths),
            length_quantiles=_quantiles(lengths) if len(lengths) else {},
            histogram_edges=tuple(edges.tolist()),
            histogram_counts=tuple(counts.tolist()),
            mean_move_ratio=float(self._total.norm()) / lengths.sum() if moved else math.nan,
            effective_rank=_effective_rank(self._moments) if moved else 0.0,
            dimensions=dimensions,
        )


def _quantiles(values: Float64Array) -> dict[str, float]:
    return {f"{level:g}": float(np.quantile(values, level)) for level in _QUANTILES}


def _effective_rank(moments: Tensor) -> float:
    spectrum = torch.linalg.eigvalsh(moments).clamp(min=0)
    share = spectrum / spectrum.sum()
    return float(torch.exp(-torch.special.xlogy(share, share).sum()))
