"""Observations of a log on disk, by the position of their row, so that a sort need not move them.

The engine sorts within a limit only rows of which it can hold some thousand for every thread. Rows
of a thousand numbers are sorted by their keys alone, and their observations fetched in that order.
"""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Float32Array, IntArray
from ucfrec.logs.engine import as_numpy
from ucfrec.logs.typed import ROWS, TypedLog


class RowVectors:
    """The observation of every row of a log, in a file."""

    def __init__(self, log: TypedLog, file: Path) -> None:
        """
        Args:
            log: with observations, all of them finite.
            file: to write.
        """
        self._file, self._size = file, log.vector_size[schema.OBSERVATION]
        rows, query = 0, f"SELECT row, {schema.OBSERVATION} FROM {ROWS}"
        with file.open("xb") as out:
            for batch in log.connection.sql(query).to_arrow_reader(log.batch_rows):
                # What is at the place of a row must be its own: the engine keeps their order.
                places = as_numpy(batch.column(0))
                assert np.array_equal(places, np.arange(rows + 1, rows + 1 + len(places)))
                out.write(np.ascontiguousarray(as_numpy(batch.column(1).flatten())).data)
                rows += len(places)
        self._values: np.memmap[Any, np.dtype[np.float32]] = np.memmap(
            file, np.float32, "r", shape=(rows, self._size)
        )
        # Neighbours of a row in the file are hardly ever its neighbours in the order.
        self._advise("MADV_RANDOM")

    def _advise(self, advice: str) -> None:
        """Advise the system how the file is read; Windows takes no advice."""
        if hasattr(mmap, advice):
            self._map.madvise(getattr(mmap, advice))

    @property
    def _map(self) -> mmap.mmap:
        found = self._values._mmap  # type: ignore[attr-defined]
        assert isinstance(found, mmap.mmap)
        return found

    def of(self, rows: IntArray) -> Float32Array:
        """(M, O) observations of the rows at the positions (M,), from 1."""
        values = np.asarray(self._values[rows - 1])
        # Pages of a mapped file count as the memory of a process that must keep to a limit.
        self._advise("MADV_DONTNEED")
        return values

    def joined(self, batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        """Batches with the column `row`, each with the observations of its rows; then the file is
        removed."""
        for batch in batches:
            values = self.of(as_numpy(batch.column("row")))
            numbers = pa.Array.from_buffers(pa.float32(), values.size, [None, pa.py_buffer(values)])
            column = pa.FixedSizeListArray.from_arrays(numbers, self._size)
            yield batch.append_column(schema.OBSERVATION, column)
        self._file.unlink()
