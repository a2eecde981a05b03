"""Moments of batches are those of all numbers at once."""

import numpy as np

from ucfrec.logs.moments import Moments


def test_batches_give_the_moments_of_all() -> None:
    generator = np.random.default_rng(0)
    values = 1e9 + generator.normal(size=(2, 1000)) * [[1], [3]]
    moments = Moments(2)
    for part in np.split(values, [0, 1, 10, 700], axis=1):
        moments.add(*part)
    assert moments.count == 1000
    np.testing.assert_allclose(moments.mean, values.mean(axis=1), rtol=1e-15)
    np.testing.assert_allclose(moments.covariance, np.cov(values, ddof=0), rtol=1e-6)
