"""Gradient-boosted trees, fitted by scikit-learn and kept as tensors: data, never a program."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Array

_SETTINGS: Final = {
    "learning_rate": 0.2,
    "max_iter": 100,
    "max_leaf_nodes": 8,
    "early_stopping": True,
}


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

    @classmethod
    def fit(cls, inputs: Array, target: Array, seed: int) -> Self:
        """Boosted log-odds of a bool target (M,), from inputs (M, F).

        A tenth of the rows, drawn by `seed`, decides when to stop.
        """
        from sklearn.ensemble import HistGradientBoostingClassifier

        model = HistGradientBoostingClassifier(random_state=seed, **_SETTINGS).fit(inputs, target)
        trees = [trees[0].nodes for trees in model._predictors]
        size = max(len(nodes) for nodes in trees)
        columns = {each.name: np.zeros((len(trees), size)) for each in fields(cls)[:-1]}
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
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor]) -> Self:
        """From `tensors`; unlike those of `fit`, they may come from anywhere.

        Raises:
            ValueError: they are no trees.
        """
        given: dict[str, Any] = {each.name: tensors[each.name] for each in fields(cls)}
        shape = given["values"].shape
        for name, most in (("inputs", 2**15), ("left", shape[1]), ("right", shape[1])):
            numbers = given[name]
            if numbers.shape != shape or numbers.dtype != torch.int64:
                raise ValueError(f"{name} are no numbers of nodes")
            if bool(((numbers < 0) | (numbers >= most)).any()):
                raise ValueError(f"{name} are beyond the trees")
        return cls(**given)

    @cached_property
    def depth(self) -> int:
        """Largest number of steps from a root to a leaf."""
        nodes, reached, depth = self.values.shape[1], torch.zeros_like(self.left[:, :1]), 0
        while depth < nodes:
            children = [side.gather(1, reached) for side in (self.left, self.right)]
            if torch.equal(children[0], reached) and torch.equal(children[1], reached):
                break
            reached, depth = torch.cat(children, 1), depth + 1
        return depth

    def __call__(self, inputs: Tensor) -> Tensor:
        """Log-odds (M,) float64 from inputs (M, F)."""
        columns = inputs.double().T
        trees, rows = self.values.shape[0], columns.shape[1]
        node = torch.zeros(trees, rows, dtype=torch.int64)
        row = torch.arange(rows).expand(trees, rows)
        for _ in range(self.depth):
            value = columns[self.inputs.gather(1, node), row]
            goes_left = value <= self.thresholds.gather(1, node)
            node = torch.where(goes_left, self.left.gather(1, node), self.right.gather(1, node))
        return self.base + self.values.gather(1, node).sum(0)
