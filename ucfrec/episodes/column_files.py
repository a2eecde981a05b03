"""Columns of a store as files: one a shard, mapped into memory."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.episodes.record import StoreRecord
from ucfrec.errors import InputError, one_line
from ucfrec.files.checksums import Sealed

_REMEDY: Final = StoreRecord.REMEDY
_DTYPES: Final = {
    schema.OFFSETS: "<i8",
    schema.RETURN_TO_GO: "<f4",
    **schema.STEP_DTYPES,
    **schema.EPISODE_DTYPES,
}


def load_column(
    store: Path, file: str, shape: tuple[int, ...], mmap: bool, sealed: Sealed
) -> Array:
    """A column of one shard.

    Args:
        file: of the column, named `SHARD/COLUMN.npy`.
        shape: of each row.
        mmap: whether the file stays mapped instead of being read.

    Raises:
        InputError: the file is missing or damaged, or holds something else.
    """
    sealed.require(file)
    path = store / file
    try:
        # Mapping compares the header with the size of the file before it takes memory.
        values: Array = np.load(path, mmap_mode="r")
    except Exception as error:  # numpy parses headers as Python and raises what that raises
        message = one_line(str(error)) or type(error).__name__
        raise InputError(f"{path} is missing or damaged ({message}); {_REMEDY}") from None
    if values.dtype != _DTYPES[path.stem] or values.shape[1:] != shape or values.ndim == 0:
        raise InputError(
            f"{path} is damaged: it holds {values.dtype} in the shape {values.shape}; {_REMEDY}"
        )
    return values if mmap else np.array(values)


class StepColumn:
    """A step column, indexed across its shards."""

    def __init__(self, parts: list[Array], kept: IntArray | None = None) -> None:
        """
        Args:
            parts: one a shard, (M,) or (M, size).
            kept: dimensions that values have; None for all.
        """
        self._parts, self._kept = parts, kept
        self._bounds = np.cumsum([0] + [len(part) for part in self._parts])

    def __len__(self) -> int:
        return int(self._bounds[-1])

    def of_dimensions(self, kept: IntArray) -> "StepColumn":
        """The same column with some dimensions of those that it has, (K,) indices."""
        return StepColumn(self._parts, kept if self._kept is None else self._kept[kept])

    def range(self) -> tuple[Any, Any]:
        """The lowest and the highest value."""
        return min(part.min() for part in self._parts), max(part.max() for part in self._parts)

    def take(self, index: IntArray) -> Array:
        """A copy of the values at the indices `index`, of any shape."""
        values = self._taken(index)
        return values if self._kept is None else values[..., self._kept]

    def between(self, begin: int, end: int) -> Array:
        """The values from index `begin` to before `end`; of one shard, without a copy."""
        first = int(np.searchsorted(self._bounds, begin, side="right")) - 1
        last = int(np.searchsorted(self._bounds, end, side="left"))
        parts = [
            np.asarray(part[max(begin - low, 0) : end - low])
            for part, low in zip(self._parts[first:last], self._bounds[first:last], strict=True)
        ]
        values = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return values if self._kept is None else values[..., self._kept]

    def _taken(self, index: IntArray) -> Array:
        if len(self._parts) == 1:
            return np.asarray(self._parts[0][index])
        shard = np.searchsorted(self._bounds[1:-1], index, side="right")
        first = self._parts[0]
        values = np.empty((*index.shape, *first.shape[1:]), dtype=first.dtype)
        for i, part in enumerate(self._parts):
            in_shard = shard == i
            values[in_shard] = part[index[in_shard] - self._bounds[i]]
        return values
