"""Truncated singular value decomposition of a sparse matrix that lies on disk."""

from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

import numpy as np
from scipy import sparse

from ucfrec.arrays import Float64Array

_OVERSAMPLES: Final = 10
_SMALL: Final = 1e-10
"""Eigenvalues below this share of the largest are rounding errors."""


class SparseRows:
    """A sparse matrix on disk, in blocks of consecutive rows."""

    def __init__(self, path: Path, n_columns: int) -> None:
        """
        Args:
            path: of a new file for scratch.
            n_columns: of the matrix.
        """
        self._file: IO[bytes] = path.open("w+b")
        self._blocks: list[tuple[int, int]] = []
        self.shape = (0, n_columns)

    def append(self, rows: sparse.csr_matrix) -> None:
        """Append rows with float32 values."""
        for array, dtype in ((rows.indptr, "<i8"), (rows.indices, "<i4"), (rows.data, "<f4")):
            self._file.write(np.ascontiguousarray(array, dtype=dtype).data)
        self._blocks.append((rows.shape[0], rows.nnz))
        self.shape = (self.shape[0] + rows.shape[0], self.shape[1])

    def blocks(self) -> Iterator[sparse.csr_matrix]:
        """The rows, as they were appended."""
        self._file.seek(0)
        for rows, values in self._blocks:
            starts = np.fromfile(self._file, "<i8", rows + 1)
            columns = np.fromfile(self._file, "<i4", values)
            data = np.fromfile(self._file, "<f4", values)
            index = starts.astype(np.int32) if values < 2**31 else starts
            yield sparse.csr_matrix((data, columns, index), shape=(rows, self.shape[1]))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def right_singular_vectors(
    matrix: SparseRows, by_column: Float64Array, rank: int
) -> tuple[Float64Array, Float64Array]:
    """Largest singular values and right singular vectors of a matrix whose columns are divided.

    The randomised subspace iteration of Halko, Martinsson and Tropp (2011), with the sizes, numbers
    of iterations and random start of scikit-learn's `randomized_svd`, so that both agree but for
    rounding (products are in float32) and signs. Only matrices with a row for each column are in
    memory; scikit-learn would also need some with a row for each row.

    Args:
        matrix: (m, n).
        by_column: (n,) what columns are divided by, above 0.
        rank: number of vectors, at most min(m, n).

    Returns:
        Singular values (rank,), and vectors (rank, n), each with its largest entry above 0. Values
        beyond the rank of the matrix are 0, and so are their vectors.
    """
    m, n = matrix.shape
    random = np.random.RandomState(0)
    width = rank + _OVERSAMPLES
    if m < n:
        basis = np.zeros((n, width))
        for block in matrix.blocks():
            basis += block.T @ random.normal(size=(block.shape[0], width)).astype(np.float32)
        basis /= by_column[:, None]
    else:
        basis = random.normal(size=(n, width))
    for _ in range(7 if rank < 0.1 * min(m, n) else 4):
        basis = _there_and_back(matrix, by_column, _orthonormal(basis))
    basis, _ = np.linalg.qr(basis)
    gram = np.zeros((basis.shape[1], basis.shape[1]))
    back = _there_and_back(matrix, by_column, basis, gram)
    if m < n:
        values, vectors = _largest(gram, rank)
        directions = (basis @ vectors).T
    else:
        # With A V = Q R, the right singular vectors of Qᵀ A are those of R⁻ᵀ (Aᵀ A V)ᵀ.
        roots, axes = _largest(gram, len(gram))
        projected = (back @ (axes * _inverse(roots))).T
        values, vectors = _largest(projected @ projected.T, rank)
        directions = (vectors * _inverse(values)).T @ projected
    signs = np.sign(directions[np.arange(rank), np.abs(directions).argmax(axis=1)])
    return values, directions * np.where(signs == 0, 1, signs)[:, None]


def _orthonormal(basis: Float64Array) -> Float64Array:
    """A basis of the same space that is orthonormal up to rounding errors."""
    try:
        # Several times faster than a QR decomposition, and exact enough between iterations.
        triangle = np.linalg.cholesky(basis.T @ basis)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.qr(basis)[0])
    return np.asarray(basis @ np.linalg.inv(triangle).T)


def _inverse(values: Float64Array) -> Float64Array:
    """1 / x, and 0 for 0."""
    return np.divide(1, values, out=np.zeros_like(values), where=values > 0)


def _largest(symmetric: Float64Array, rank: int) -> tuple[Float64Array, Float64Array]:
    """Square roots of the largest eigenvalues, descending, 0 for rounding errors; eigenvectors."""
    values, vectors = np.linalg.eigh(symmetric)
    values, vectors = values[::-1][:rank], vectors[:, ::-1][:, :rank]
    if rank > len(values):
        missing = rank - len(values)
        values = np.pad(values, (0, missing))
        vectors = np.pad(vectors, ((0, 0), (0, missing)))
    values = np.where(values > _SMALL * max(values[0], 0), values, 0)
    return np.sqrt(values), np.where(values > 0, vectors, 0)


def _there_and_back(
    matrix: SparseRows,
    by_column: Float64Array,
    basis: Float64Array,
    gram: Float64Array | None = None,
) -> Float64Array:
    """AᵀA V for the matrix A with divided columns and a basis V; adds (A V)ᵀ(A V) to `gram`."""
    scaled = (basis / by_column[:, None]).astype(np.float32)
    back = np.zeros(basis.shape)
    for block in matrix.blocks():
        product = block @ scaled
        if gram is not None:
            gram += product.T @ product
        back += block.T @ product
    return back / by_column[:, None]
