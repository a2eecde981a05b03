"""Training on a store whose observation columns without effect are dropped, or intervened on."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from ucfrec.counterfactual.augmentation import interventions
from ucfrec.counterfactual.screening import ScreeningReport, screen
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json, write_json
from ucfrec.fitting.loop import SILENT, Callbacks
from ucfrec.runs.config import Config
from ucfrec.runs.record import RUN, RunRecord, Screening, read_record
from ucfrec.runs.run import share_stage, train_run
from ucfrec.runs.start import training_views

SCREENINGS: Final = ("drop", "copies")
"""Train without the columns, or add copies of the sessions that intervene on them."""
SEED: Final = 0
"""Of the screening before any training: which columns cause nothing is a question to the log, and
runs of other training seeds shall differ in their training only."""
SCREENING: Final = "screening"
"""Entry of a run's record: `how`, and the report of `ucfrec.counterfactual.screening`."""


def screen_store(store: EpisodeStore, seed: int) -> ScreeningReport:
    """`ucfrec.counterfactual.screening.screen` on the training sessions of a store."""
    return screen(training_views(store)[0], seed)


def train_screened(
    store: EpisodeStore,
    out: Path,
    config: Config,
    how: str | None,
    about: Mapping[str, Any] | None = None,
    shared: Path | None = None,
    callbacks: Callbacks = SILENT,
    screen: Callable[[EpisodeStore, int], ScreeningReport] | None = None,
) -> RunRecord:
    """`ucfrec.runs.run.train_run` after screening.

    Args:
        out: run folder; an interrupted run resumes, with the columns it started with.
        how: one of `SCREENINGS`; None to train on the store as it is.
        about: entries that a dataset adapter adds to the record.
        shared: as `train_run` has it, and for screening; a run whose columns are dropped has its
            other stages to itself.
        screen: screens a store, with a seed; None for `screen_store`.

    Raises:
        InputError: as `train_run` and `screen`; the run was started with another `how`; or no
            column of observed states would be left.
    """
    if how not in (None, *SCREENINGS):
        raise InputError(f"screen is {how!r}; use one of {', '.join(SCREENINGS)}")
    screening = None
    if (out / RUN).exists():
        screening = read_record(out).screening
        started_with = None if screening is None else screening.how
        if started_with != how:
            option = f" --screen {started_with}" if started_with else "out --screen"
            raise InputError(
                f"{out} was started with{option}; name another run folder, or give the same "
                "options to resume"
            )
    if how is None:
        return train_run(store, out, config, about, shared=shared, callbacks=callbacks)
    if screening is None:
        inputs = {"screened": store.record.fingerprint, "steps": store.n_steps, "seed": SEED}
        find = screen or screen_store
        with TemporaryDirectory() as scratch:  # made once for runs that share stages
            file = Path(scratch) / "screening.json"
            share_stage(
                shared,
                inputs,
                find.__module__,
                file.parent,
                (file.name,),
                lambda: write_json(file, asdict(find(store, SEED))),
            )
            screening = Screening.model_validate({"how": how, **read_json(file)})
    flagged = screening.flagged
    if len(flagged) == store.state_size:
        raise InputError(
            f"{store.path}: screening found no effect of any of the {len(flagged)} state "
            "dimensions; the log has too few steps, or too noisy ones, to decide: train without "
            "--screen"
        )
    entries: dict[str, Any] = {**(about or {}), SCREENING: screening}
    if how == "drop":
        entries["dropped_observations"] = flagged
        selected = drop_columns(store, flagged)
        return train_run(selected, out, config, entries, callbacks=callbacks)
    train, first = training_views(store)[0], store.state_size - store.observation_size
    places = [first + column for column in flagged]
    more = interventions(train, places, config.seed) if places else None
    return train_run(store, out, config, entries, more, shared=shared, callbacks=callbacks)


def drop_columns(store: EpisodeStore, columns: Sequence[int]) -> EpisodeStore:
    """`store` without some columns of its observations; itself if there are none."""
    return store.without_observation_dimensions(columns) if columns else store
