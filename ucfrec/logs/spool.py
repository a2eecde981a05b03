"""Rows on disk, column by column: written once in order, then read in slices of bounded size."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from ucfrec.arrays import Array

BLOCK: Final = 2**19
"""Most rows of a spool that are in memory at a time."""
_BLOCK_BYTES: Final = 2**26


class Spool:
    """Columns of equal length as files of raw numbers in a scratch folder, or in memory.

    Slices are read into memory, not mapped: pages of a mapped file count as the memory of a process
    that must keep to a limit.
    """

    def __init__(self, folder: Path | None) -> None:
        """
        Args:
            folder: of the files; it is made, and must not exist; None for memory.
        """
        if folder is not None:
            folder.mkdir()
        self._folder = folder
        self._memory: dict[str, bytearray] = {}
        self._rows: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._length = 0

    def __len__(self) -> int:
        return self._length

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, once there are rows."""
        return tuple(self._rows)

    @property
    def block_rows(self) -> int:
        """Rows to have in memory at a time, fewer if they are long, once there are rows."""
        size = sum(dtype.itemsize * int(np.prod(shape)) for dtype, shape in self._rows.values())
        return min(BLOCK, max(_BLOCK_BYTES // max(size, 1), 1))

    def append(self, columns: Mapping[str, Array]) -> None:
        """Append rows, the same columns every time.

        Args:
            columns: each (M,) or (M, size), of its own dtype, which stays the same.
        """
        for name, values in columns.items():
            self._rows.setdefault(name, (values.dtype, values.shape[1:]))
            if self._folder is None:
                self._memory.setdefault(name, bytearray()).extend(values.tobytes())
                continue
            with self._file(name).open("ab") as file:
                file.write(np.ascontiguousarray(values).data)
        self._length += len(next(iter(columns.values())))

    def read(self, name: str, start: int, stop: int) -> Array:
        """Rows `start` to `stop` of a column, after the last `append`."""
        dtype, shape = self._rows[name]
        size = int(np.prod(shape, dtype=np.int64))
        count, offset = (stop - start) * size, start * size * dtype.itemsize
        if self._folder is None:
            values = np.frombuffer(self._memory[name], dtype, count, offset).copy()
        else:
            values = np.fromfile(self._file(name), dtype, count, offset=offset)
        return values.reshape(-1, *shape)

    def _file(self, name: str) -> Path:
        assert self._folder is not None
        return self._folder / f"{name}.bin"


def whole_groups(batches: Iterable[dict[str, Array]], *keys: str) -> Iterator[dict[str, Array]]:
    """The same rows in batches that end between two groups of rows with equal `keys`."""
    held: dict[str, Array] = {}
    for batch in batches:
        if held:
            batch = {name: np.concatenate([held[name], batch[name]]) for name in batch}
        differ = [batch[key][1:] != batch[key][:-1] for key in keys]
        ends = np.flatnonzero(np.logical_or.reduce(differ))
        if not len(ends):
            held = batch
            continue
        end = int(ends[-1]) + 1
        yield {name: values[:end] for name, values in batch.items()}
        held = {name: values[end:].copy() for name, values in batch.items()}
    if held and len(held[keys[0]]):
        yield held
