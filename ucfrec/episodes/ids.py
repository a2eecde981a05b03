"""Which number an identifier of a user or an item has."""

from functools import cached_property

import numpy as np

from ucfrec.arrays import Array, IntArray


class IdLookup:
    """Finds identifiers among those of a run or store: they are equal if their text is."""

    def __init__(self, ids: Array) -> None:
        """Args:
        ids: (n,) different integers or texts; their positions are the numbers.
        """
        self.ids = ids
        self._whole = np.can_cast(ids.dtype, np.int64)
        self._order = np.argsort(ids, kind="stable") if self._whole else np.empty(0, np.int64)
        self._sorted = ids[self._order]

    def __len__(self) -> int:
        return len(self.ids)

    def numbers(self, wanted: Array) -> IntArray:
        """Number of each of the identifiers (N,), int64; −1 for those that are not listed."""
        if not (len(wanted) and len(self.ids)):
            return np.full(len(wanted), -1)
        if self._whole and np.can_cast(wanted.dtype, np.int64):
            # One search costs less than a table for as few as a request has.
            places = np.minimum(np.searchsorted(self._sorted, wanted), len(self._sorted) - 1)
            return np.where(self._sorted[places] == wanted, self._order[places], -1)
        table = self._of_text
        return np.array([table.get(str(each), -1) for each in wanted.tolist()], dtype=np.int64)

    @cached_property
    def _of_text(self) -> dict[str, int]:
        return {str(each): number for number, each in enumerate(self.ids.tolist())}
