"""Gradient-boosted trees, fitted by scikit-learn and kept as tensors: data, never a program."""

from collections.abc import Mapping
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

_NODES: Final = ("inputs", "thresholds", "left", "right", "values")


@dataclass(frozen=True)
class BoostedTrees:
    """The sum of T regression trees of at most N nodes; node 0 is a tree's root.

    A node sends a row to `left` if its input is at most the threshold; leaves send rows to
    themselves.
    """

    inputs: Tensor
    """(T, N) int64 number of the input that a node looks at."""
    thresholds: Tensor
    """(T, N) float64."""
    left: Tensor
    """(T, N) int64."""
    right: Tensor
    """(T, N) int64."""
    values: Tensor
    """(T, N) float64."""
    base: Tensor
    """() float64, what the trees' sum starts from."""
    depth: int = field(init=False)
    """Largest number of steps from a root to a leaf."""

    @classmethod
    def fit(cls, inputs: Array, target: Array, seed: int) -> Self:
        """Boosted log-odds of a bool target (M,), from inputs (M, F).

        A tenth of the rows, drawn by `seed`, decides when to stop.
        """
        from sklearn.ensemble import HistGradientBoostingClassifier

        model = HistGradientBoostingClassifier(random_state=seed, **_SETTINGS).fit(inputs, target)
        trees = [trees[0].nodes for trees in model._predictors]
        size = max(len(nodes) for nodes in trees)
        columns = {name: np.zeros((len(trees), size)) for name in _NODES}
        for tree, nodes in enumerate(trees):
            own, leaf = np.arange(len(nodes)), nodes["is_leaf"] == 1
            for name, values in (
                ("inputs", np.where(leaf, 0, nodes["feature_idx"])),
                ("thresholds", np.where(leaf, 0.0, nodes["num_threshold"])),
                ("left", np.where(leaf, own, nodes["left"])),
                ("right", np.where(leaf, own, nodes["right"])),
                ("values", nodes["value"]),
            ):
                columns[name][tree, : len(nodes)] = values
        whole = ("inputs", "left", "right")
        tensors = {name: torch.from_numpy(each) for name, each in columns.items()}
        tensors |= {name: tensors[name].long() for name in whole}
        return cls(**tensors, base=torch.tensor(float(model._baseline_prediction.item())).double())

    def tensors(self) -> dict[str, Tensor]:
        """The fields by name, to be saved."""
        return {name: getattr(self, name) for name in (*_NODES, "base")}

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor]) -> Self:
        """From `tensors`; unlike those of `fit`, they may come from anywhere.

        Raises:
            ValueError: they are no trees.
        """
        given = {name: tensors[name] for name in (*_NODES, "base")}
        shape = given["values"].shape
        for name, most in (("inputs", 2**15), ("left", shape[1]), ("right", shape[1])):
            numbers = given[name]
            if numbers.shape != shape or numbers.dtype != torch.int64:
                raise ValueError(f"{name} are no numbers of nodes")
            if bool(((numbers < 0) | (numbers >= most)).any()):
                raise ValueError(f"{name} are beyond the trees")
        return cls(**given)

    def __post_init__(self) -> None:
        nodes, reached, depth = self.values.shape[1], torch.zeros_like(self.left[:, :1]), 0
        while depth < nodes and not torch.equal(self.left.gather(1, reached), reached):
            children = [side.gather(1, reached) for side in (self.left, self.right)]
            reached, depth = torch.unique(torch.cat(children, 1), dim=1), depth + 1
        object.__setattr__(self, "depth", depth)

    def __call__(self, inputs: Tensor) -> Tensor:
        """Log-odds (M,) float64 from inputs (M, F)."""
        columns = inputs.double().T
        node = torch.zeros(self.values.shape[0], columns.shape[1], dtype=torch.int64)
        for _ in range(self.depth):
            values = columns.gather(0, self.inputs.gather(1, node))
            goes_left = values <= self.thresholds.gather(1, node)
            node = torch.where(goes_left, self.left.gather(1, node), self.right.gather(1, node))
        return self.base + self.values.gather(1, node).sum(0)
