"""Means and covariances of numbers that come in batches."""

import numpy as np

from ucfrec.arrays import Array, Float64Array


class Moments:
    """Number, mean and sums of squared deviations of vectors of one size.

    Batches are merged by the formula of Chan, Golub and LeVeque (1983), whose rounding errors do
    not grow with the mean.
    """

    def __init__(self, size: int) -> None:
        """
        Args:
            size: of a vector.
        """
        self.count = 0
        self.mean = np.zeros(size)
        self._deviations = np.zeros((size, size))

    def add(self, *values: Array) -> None:
        """Add M vectors.

        Args:
            values: (M,) numbers of each of their entries.
        """
        batch = np.array(values, dtype=np.float64)
        if not batch.shape[1]:
            return
        mean = batch.mean(axis=1)
        centred = batch - mean[:, None]
        apart = mean - self.mean
        total = self.count + batch.shape[1]
        self._deviations += centred @ centred.T
        self._deviations += np.outer(apart, apart) * (self.count * batch.shape[1] / total)
        self.mean += apart * (batch.shape[1] / total)
        self.count = total

    @property
    def covariance(self) -> Float64Array:
        """(size, size) covariance of all vectors so far, not corrected for their number."""
        return self._deviations / max(self.count, 1)
