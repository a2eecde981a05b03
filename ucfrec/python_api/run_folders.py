"""The folders that `Recommender.fit` leaves: a temporary run, or a run with its store beside it."""

import weakref
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.updating.update import STORE_SUFFIX


class Scratch:
    """The folder of a temporary run, removed once no recommender and no copy of one has it."""

    def __init__(self, folder: ExitStack) -> None:
        weakref.finalize(self, folder.close)

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        # Another process cannot keep the folder: what is read from a pickle has none.
        return type(None), ()


def kept_beside(run: Path, store: EpisodeStore) -> EpisodeStore:
    """A new store, moved beside the folder of its run.

    Raises:
        InputError: a store of other logs lies there already.
    """
    place = run.with_name(run.name + STORE_SUFFIX)
    if not place.exists():
        store.path.rename(place)
    kept = EpisodeStore.open(place)
    if kept.record.fingerprint != store.record.fingerprint:
        raise InputError(
            f"{place} is a store of other logs than these; name another folder than {run}, or "
            "remove both"
        )
    return kept
