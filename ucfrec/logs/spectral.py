"""Truncated singular value decomposition of a sparse matrix that lies on disk."""

from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

Array = npt.NDArray[Any]
FloatArray = npt.NDArray[np.float64]

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
    matrix: SparseRows, by_row: FloatArray, by_column: FloatArray, rank: int, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Largest singular values and right singular vectors of a matrix divided by row and column.

    The randomised subspace iteration of Halko, Martinsson and Tropp (2011), with the sizes, numbers
    of iterations and random start of scikit-learn's `randomized_svd`, so that both agree but for
    rounding (products are in float32) and signs. Only matrices with a row for each column are in
    memory; scikit-learn would also need some with a row for each row.

    Args:
        matrix: (m, n).
        by_row: (m,) what rows are divided by, above 0.
        by_column: (n,) what columns are divided by, above 0.
        rank: number of vectors, at most min(m, n).
        seed: of the random start.

    Returns:
        Singular values (rank,), and vectors (rank, n), each with its largest entry above 0. Values
        beyond the rank of the matrix are 0, and so are their vectors.
    """
    m, n = matrix.shape
    random = np.random.RandomState(seed)
    width = rank + _OVERSAMPLES
    iterations = 7 if rank < 0.1 * min(m, n) else 4
    if m < n:
        basis = np.zeros((n, width))
        row = 0
        for block in matrix.blocks():
            end = row + block.shape[0]
            start = random.normal(size=(block.shape[0], width)) / by_row[row:end, None]
            basis += block.T @ start.astype(np.float32)
            row = end
        basis /= by_column[:, None]
    else:
        basis = random.normal(size=(n, width))
    for _ in range(iterations):
        basis, _ = np.linalg.qr(basis)
        basis, _ = _products(matrix, by_row, by_column, basis)
    basis, _ = np.linalg.qr(basis)
    back, gram = _products(matrix, by_row, by_column, basis)
    if m < n:
        values, vectors = _largest(gram, rank)
        directions = (basis @ vectors).T
    else:
        # With A V = Q R, the right singular vectors of Qᵀ A are those of R⁻ᵀ (Aᵀ A V)ᵀ.
        squares, axes = _largest(gram, len(gram))
        scale = np.where(squares > 0, 1 / np.where(squares > 0, squares, 1), 0)
        projected = (back @ (axes * scale)).T
        values, vectors = _largest(projected @ projected.T, rank)
        scale = np.where(values > 0, 1 / np.where(values > 0, values, 1), 0)
        directions = (vectors * scale).T @ projected
    signs = np.sign(directions[np.arange(rank), np.abs(directions).argmax(axis=1)])
    return values, directions * np.where(signs == 0, 1, signs)[:, None]


def _largest(symmetric: FloatArray, rank: int) -> tuple[FloatArray, FloatArray]:
    """Square roots of the largest eigenvalues, descending, 0 for rounding errors; eigenvectors."""
    values, vectors = np.linalg.eigh(symmetric)
    values, vectors = values[::-1][:rank], vectors[:, ::-1][:, :rank]
    if rank > len(values):
        missing = rank - len(values)
        values = np.pad(values, (0, missing))
        vectors = np.pad(vectors, ((0, 0), (0, missing)))
    values = np.where(values > _SMALL * max(values[0], 0), values, 0)
    return np.sqrt(values), np.where(values > 0, vectors, 0)


def _products(
    matrix: SparseRows, by_row: FloatArray, by_column: FloatArray, basis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """AᵀA V and (A V)ᵀ(A V) for the divided matrix A and a basis V."""
    scaled = (basis / by_column[:, None]).astype(np.float32)
    back = np.zeros(basis.shape)
    gram = np.zeros((basis.shape[1], basis.shape[1]))
    row = 0
    for block in matrix.blocks():
        end = row + block.shape[0]
        weights = (1 / by_row[row:end, None]).astype(np.float32)
        product = (block @ scaled) * weights
        gram += product.T @ product
        product *= weights
        back += block.T @ product
        row = end
    return back / by_column[:, None], gram
