"""What `Recommender.fit` and `ucfrec train` do alike; and the folders that the former leaves."""

import shutil
import weakref
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, warn_user
from ucfrec.fitting.distributed import leads, processes
from ucfrec.fitting.loop import SILENT, Callbacks
from ucfrec.reporting.model_card import write_card
from ucfrec.runs.config import Config
from ucfrec.runs.record import REFIT, STORE_SUFFIX, RunRecord
from ucfrec.runs.refit import refit_within
from ucfrec.runs.run import train_run


def train_policy(
    store: EpisodeStore,
    out: Path,
    config: Config,
    refit: bool,
    callbacks: Callbacks = SILENT,
) -> RunRecord:
    """Train a policy and write its model card. Errors are those of `train_run`.

    Args:
        out: run folder; an interrupted run resumes.
        refit: whether it goes on learning from all rows once everything is chosen, which several
            processes do not; without it, the weights of the training rows are kept.
    """
    record = train_run(store, out, config, callbacks=callbacks)
    if not refit:
        shutil.rmtree(out / REFIT, ignore_errors=True)
    elif processes() == 1:
        refit_within(store, out)
    elif leads():
        warn_user(
            "several processes do not learn from all rows; run the same command in one process, "
            "which then only does that"
        )
    if leads():
        write_card(out)
    return record


class Scratch:
    """The folder of a temporary run, removed once no recommender and no copy of one has it."""

    def __init__(self, folder: ExitStack) -> None:
        weakref.finalize(self, folder.close)

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        # Another process cannot keep the folder: what is read from a pickle has none.
        return type(None), ()


def keep_beside(run: Path, store: EpisodeStore) -> EpisodeStore:
    """A new store, moved beside the folder of its run. InputError if a store of other logs lies
    there already."""
    place = run.with_name(run.name + STORE_SUFFIX)
    if not place.exists():
        store.path.rename(place)
    moved = EpisodeStore.open(place)
    if moved.record.fingerprint != store.record.fingerprint:
        raise InputError(
            f"{place} is a store of other logs than these; name another folder than {run}, or "
            "remove both"
        )
    return moved
