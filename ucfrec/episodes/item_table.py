"""Items without torch, which preparing a log does not need: numbers, and the file of states."""

from functools import cached_property
from pathlib import Path

import numpy as np

from ucfrec.arrays import Array, Float32Array, IntArray
from ucfrec.files.atomic import save_arrays

ITEM_STATES = "item_states.safetensors"
"""Name of the file in a store or a run."""
OFFERS = "offers.safetensors"
"""Name of the file of `Offers` in a store or a run; missing where everything is always on offer."""
ALWAYS = -(2**62), 2**62
"""Begin and end, in ms, of an interval without bounds."""
DISTINCT_TAGS = 1000
"""Most tags of a catalogue that are distinguished; rarer ones are excluded."""
TAGS_PER_ITEM = 16
"""Most tags that one item keeps."""
WINDOW = 10
"""Number of most recent steps that enter the means of a state."""
DECAY = 0.8
"""Factor by which the weight in the means falls with each step back."""


def write_item_table(
    path: Path,
    embeddings: Float32Array,
    user_features: Float32Array,
    tags: IntArray | None,
    reward_low: float,
    reward_high: float,
    window: int = WINDOW,
    decay: float = DECAY,
) -> None:
    """Write the file of `ucfrec.episodes.states.ItemStates`, atomically; arguments are its fields,
    with None for no tags. InputError if the disk is full."""
    numbers = {"window": window, "decay": decay}
    numbers |= {"reward_low": reward_low, "reward_high": reward_high}
    arrays: dict[str, Array] = {"embeddings": embeddings, "user_features": user_features}
    if tags is not None and tags.shape[1]:
        arrays["tags"] = tags
    plain = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    save_arrays(path, plain, numbers)


class IdLookup:
    """Finds identifiers among those of a run or store: they are equal if their text is."""

    def __init__(self, ids: Array) -> None:
        """Args:
        ids: (n,) different integers or texts; their positions are the numbers.
        """
        self.ids = ids
        self._whole = np.can_cast(ids.dtype, np.int64)
        self._low, high = 0, -1
        if self._whole and len(ids):
            self._low, high = int(ids.min()), int(ids.max())
        self._dense = self._whole and high - self._low < 4 * len(ids)  # of others, a table is large
        if self._dense:
            self._order = np.full(high - self._low + 1, -1)
            self._order[ids.astype(np.int64) - self._low] = np.arange(len(ids))
        elif self._whole:
            self._order = np.argsort(ids, kind="stable")
            self._sorted = ids[self._order]

    def __len__(self) -> int:
        return len(self.ids)

    def numbers(self, ids: Array) -> IntArray:
        """Number of each of the identifiers (N,), int64; −1 for those that are not listed."""
        if not (len(ids) and len(self.ids)):
            return np.full(len(ids), -1)
        if self._whole and np.can_cast(ids.dtype, np.int64):
            if self._dense:
                numbers = self._order.take(ids.astype(np.int64) - self._low, mode="clip")
                return np.where(self.ids[numbers] == ids, numbers, -1)
            # One search costs less than a table for as few as a request has.
            places = np.minimum(np.searchsorted(self._sorted, ids), len(self._sorted) - 1)
            return np.where(self._sorted[places] == ids, self._order[places], -1)
        table = self._of_text
        return np.array([table.get(str(value), -1) for value in ids.tolist()], dtype=np.int64)

    @cached_property
    def _of_text(self) -> dict[str, int]:
        return {str(value): number for number, value in enumerate(self.ids.tolist())}
