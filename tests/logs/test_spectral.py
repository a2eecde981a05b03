"""The decomposition from disk is scikit-learn's, up to rounding and signs."""

from pathlib import Path

import numpy as np
import pytest
from scipy import sparse
from sklearn.utils.extmath import randomized_svd

from ucfrec.logs.spectral import SparseRows, right_singular_vectors


def on_disk(path: Path, matrix: sparse.csr_matrix) -> SparseRows:
    rows = SparseRows(path, matrix.shape[1])
    for begin in range(0, matrix.shape[0], 37):
        rows.append(matrix[begin : begin + 37])
    return rows


@pytest.mark.parametrize("shape", [(400, 90), (90, 400), (60, 60)])
def test_it_is_that_of_scikit_learn(tmp_path: Path, shape: tuple[int, int]) -> None:
    generator = np.random.default_rng(0)
    strong = generator.normal(size=(shape[0], 4)) @ generator.normal(size=(4, shape[1]))
    dense = np.where(generator.random(shape) < 0.3, 3 + strong + generator.normal(size=shape), 0)
    matrix = sparse.csr_matrix(dense.astype(np.float32))
    by_column = 1 + generator.random(shape[1])
    found, vectors = right_singular_vectors(on_disk(tmp_path / "m", matrix), by_column, 12)
    divided = matrix.astype(np.float64) @ sparse.diags(1 / by_column)
    _, values, expected = randomized_svd(divided, 12, random_state=0)
    np.testing.assert_allclose(found, values, rtol=1e-5)
    signs = np.sign((vectors * expected).sum(axis=1))
    np.testing.assert_allclose(vectors * signs[:, None], expected, atol=1e-4)
    assert (vectors[np.arange(12), np.abs(vectors).argmax(axis=1)] > 0).all()


def test_directions_beyond_the_rank_are_zero(tmp_path: Path) -> None:
    matrix = sparse.csr_matrix(np.outer(np.arange(1, 6), [1.0, 0, 2, 0]).astype(np.float32))
    values, vectors = right_singular_vectors(on_disk(tmp_path / "m", matrix), np.ones(4), 3)
    np.testing.assert_allclose(values, [np.sqrt(55 * 5), 0, 0], rtol=1e-6)
    np.testing.assert_allclose(vectors[0], np.array([1, 0, 2, 0]) / np.sqrt(5), atol=1e-6)
    assert not vectors[1:].any()
