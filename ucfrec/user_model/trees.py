"""Gradient-boosted trees, fitted by scikit-learn and kept as tensors: data, never a program."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Array

TREES: Final = 100
LEAVES: Final = 8
"""Most trees, and leaves of a tree."""
_SETTINGS: Final = {
    "learning_rate": 0.2,
    "max_iter": TREES,
    "max_leaf_nodes": LEAVES,
    "early_stopping": True,
}

_SPLITS: Final = LEAVES - 1
_TENSORS: Final = ("inputs", "thresholds", "leaves", "base")


@dataclass(frozen=True)
class BoostedTrees:
    """The sum of T regression trees of at most S splits.

    A tree is a table: which of its splits' inputs are at most their threshold selects the leaf.
    """

    inputs: Tensor
    """(T, S) int64 number of the input that a split looks at."""
    thresholds: Tensor
    """(T, S) float64."""
    leaves: Tensor
    """(T, 2^S) float64 values; bit s of a column's number is set where split s finds an input that
    is at most its threshold."""
    base: Tensor
    """() float64, what the trees' sum starts from."""
    _splits: tuple[Tensor, Tensor] = field(init=False)
    """Input and threshold (U,) of the different splits."""
    _bits: Tensor = field(init=False)
    """(T, U) float32 bits of the columns' numbers that a split stands for."""
    _places: dict[int, slice] = field(init=False)
    """Where the splits of an input are among the different splits."""

    @classmethod
    def fit(cls, inputs: Array, target: Array, seed: int) -> Self:
        """Boosted log-odds of a bool target (M,), from inputs (M, F).

        A tenth of the rows, drawn by `seed`, decides when to stop.
        """
        from sklearn.ensemble import HistGradientBoostingClassifier

        model = HistGradientBoostingClassifier(random_state=seed, **_SETTINGS).fit(inputs, target)
        tables = [_table(trees[0].nodes) for trees in model._predictors]
        splits, thresholds, leaves = (
            torch.from_numpy(np.stack(entry)) for entry in zip(*tables, strict=True)
        )
        base = torch.tensor(float(model._baseline_prediction.item())).double()
        return cls(splits, thresholds, leaves, base)

    def tensors(self) -> dict[str, Tensor]:
        """The tables by name, to be saved."""
        return {name: getattr(self, name) for name in _TENSORS}

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], count: int) -> Self:
        """From `tensors`; unlike those of `fit`, they may come from anywhere.

        Args:
            count: number of inputs.

        Raises:
            ValueError: they are not trees.
        """
        inputs, thresholds, leaves, base = (tensors[name] for name in _TENSORS)
        if inputs.dim() != 2 or inputs.shape[1] > _SPLITS or inputs.dtype != torch.int64:
            raise ValueError("inputs are not numbers of inputs")
        if bool(((inputs < 0) | (inputs >= count)).any()):
            raise ValueError("inputs are beyond the last input")
        if any(entry.dtype != torch.float64 for entry in (thresholds, leaves, base)):
            raise ValueError("thresholds, leaves and base are not float64")
        shapes = thresholds.shape, leaves.shape, base.shape
        if shapes != (inputs.shape, (len(inputs), 2 ** inputs.shape[1]), ()):
            raise ValueError("thresholds, leaves and base do not fit the inputs")
        return cls(inputs, thresholds, leaves, base)

    def __post_init__(self) -> None:
        pairs = torch.stack([self.inputs.double(), self.thresholds], 2).flatten(0, 1)
        splits, which = torch.unique(pairs, dim=0, return_inverse=True)
        bits = torch.zeros(len(self.inputs), len(splits))
        powers = (2.0 ** torch.arange(self.inputs.shape[1])).expand(self.inputs.shape)
        bits.scatter_add_(1, which.view(self.inputs.shape), powers)
        numbers = splits[:, 0].long()
        present, counts = (entry.tolist() for entry in numbers.unique(return_counts=True))
        ends = np.cumsum(counts).tolist()
        places = {i: slice(end - n, end) for i, n, end in zip(present, counts, ends, strict=True)}
        object.__setattr__(self, "_places", places)
        object.__setattr__(self, "_splits", (numbers, splits[:, 1:]))
        object.__setattr__(self, "_bits", bits)

    def __call__(self, inputs: Tensor) -> Tensor:
        """Log-odds (M,) float64 from inputs (M, F)."""
        return self._sums(self._bits @ self._at_most(inputs))

    def with_values(self, inputs: Tensor, number: int, values: Sequence[Tensor]) -> list[Tensor]:
        """Log-odds (M,) as from `inputs` with one of them replaced by each of some values (M,).

        Args:
            inputs: (M, F); fastest as the transpose of columns (F, M).
            number: of the input that is replaced.
        """
        places = self._places.get(number, slice(0, 0))
        at_most = self._at_most(inputs)
        at_most[places] = 0.0
        columns, bits, thresholds = (
            self._bits @ at_most,
            self._bits[:, places],
            self._splits[1][places],
        )
        return [
            self._sums(columns + bits @ (entry.double() <= thresholds).float()) for entry in values
        ]

    def _at_most(self, inputs: Tensor) -> Tensor:
        """(U, M) float32, 1 where the input of a split is at most its threshold."""
        numbers, thresholds = self._splits
        return (inputs.double().T[numbers] <= thresholds).float()

    def _sums(self, columns: Tensor) -> Tensor:
        """The trees' sum (M,) from the numbers of their columns (T, M).

        These are sums of a few powers of two, which are exact in float32.
        """
        return self.base + self.leaves.gather(1, columns.long()).sum(0)


def _table(nodes: Array) -> tuple[Array, Array, Array]:
    """Inputs (S,), thresholds (S,) and leaves (2^S,) of the nodes of one of scikit-learn's trees.

    Splits that the tree lacks look at input 0, and select nothing.
    """
    inner = np.flatnonzero(nodes["is_leaf"] == 0)
    inputs, thresholds = np.zeros(_SPLITS, dtype=np.int64), np.zeros(_SPLITS)
    inputs[: len(inner)] = nodes["feature_idx"][inner]
    thresholds[: len(inner)] = nodes["num_threshold"][inner]
    split = np.zeros(len(nodes), dtype=np.int64)
    split[inner] = np.arange(len(inner))
    outcomes = np.arange(2**_SPLITS)
    node = np.zeros(2**_SPLITS, dtype=np.int64)
    for _ in inner:
        left = (outcomes >> split[node]) & 1 == 1
        below = np.where(left, nodes["left"][node], nodes["right"][node])
        node = np.where(nodes["is_leaf"][node] == 1, node, below).astype(np.int64)
    return inputs, thresholds, nodes["value"][node]
