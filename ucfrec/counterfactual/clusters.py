"""Clusters of states, and the actions that were logged in each."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ucfrec.arrays import Array, IntArray


@dataclass(frozen=True)
class StateClusters:
    """C clusters of normalised states, found by k-means."""

    centres: Tensor
    """(C, S)."""
    covariances: Tensor
    """(C, S, S) covariance of the states of each cluster."""

    @classmethod
    def of(cls, states: Tensor, most: int, seed: int) -> "StateClusters":
        """Cluster normalised states; the clusters are on the CPU.

        Args:
            states: (M, S), on the CPU.
            most: largest number of clusters; few states make fewer.
            seed: of the first centres and the batches.
        """
        # Imported here because it takes a second and 100 MB, and loading a policy does not need it.
        from sklearn.cluster import MiniBatchKMeans

        size = states.shape[1]
        clusters = max(1, min(most, len(states) // (8 * size)))
        fitted = MiniBatchKMeans(clusters, random_state=seed, n_init=1, batch_size=4096)
        labels = torch.from_numpy(fitted.fit_predict(states.numpy()).astype(np.int64))
        centres = torch.from_numpy(fitted.cluster_centers_).float()
        whole = torch.cov(states.T, correction=0).reshape(size, size)
        covariances = torch.empty(clusters, size, size)
        for cluster in range(clusters):
            deviations = states[labels == cluster] - centres[cluster]
            squares, rows = deviations.T @ deviations, len(deviations)
            # Shrunk towards the covariance of all states, because a cluster may have few.
            covariances[cluster] = (squares + size * whole) / (rows + size)
        return cls(centres, covariances)

    def to(self, device: torch.device) -> "StateClusters":
        """The clusters on `device`."""
        return StateClusters(self.centres.to(device), self.covariances.to(device))

    def nearest(self, states: Tensor) -> Tensor:
        """(B,) cluster whose centre is nearest to each of the normalised states (B, S)."""
        return torch.cdist(states, self.centres).argmin(dim=1)


class ActionSupport:
    """The actions that the log took in each cluster of states: what else could have been done."""

    def __init__(self, labels: IntArray, actions: Array) -> None:
        """
        Args:
            labels: (M,) cluster of the state of each of M logged steps.
            actions: (M,) items or (M, A) vectors of these steps.
        """
        order = np.argsort(labels, kind="stable")
        self._actions = actions[order]
        self._counts = np.bincount(labels)
        self._starts = np.cumsum(self._counts) - self._counts

    def draw(
        self, labels: IntArray, generator: np.random.Generator
    ) -> tuple[Array, "np.typing.NDArray[np.bool_]"]:
        """The action of a random logged step of the given cluster, for each of B clusters.

        Args:
            labels: (B,) clusters.

        Returns:
            Actions, (B,) or (B, A), and (B,) whether the cluster has a logged step at all; where it
            has none, the action means nothing.
        """
        drawable = labels < len(self._counts)
        clusters = np.where(drawable, labels, 0)
        counts = np.where(drawable, self._counts[clusters], 0)
        numbers = (generator.random(len(labels)) * counts).astype(np.int64)
        places = np.minimum(self._starts[clusters] + numbers, len(self._actions) - 1)
        return self._actions[places], counts > 0
