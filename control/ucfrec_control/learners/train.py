"""Training on a control store: presets beneath, the data's origin in the record."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.provenance import versions
from ucfrec.runs.config import Config
from ucfrec.runs.run import train_run, training_views
from ucfrec.runs.trained_policy import RUN
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.learners.presets import Preset, find_preset
from ucfrec_control.learners.screening import ScreeningConfig, interventions, screen
from ucfrec_control.worlds.scores import find_kind, find_task

UNSEEN = "unseen"
SCREENINGS = {"copies": "screened", "drop": UNSEEN}
"""What is done about dimensions that cause nothing, and where a run's record of its dataset lists
those that it was done to."""


def dataset_of(store: EpisodeStore) -> Mapping[str, Any]:
    """Where the trajectories of `store` come from.

    Raises:
        InputError: it is not a control store.
    """
    source: Mapping[str, Any] = store.meta["source"]
    if "env_id" not in source:
        raise InputError(f"{store.path} was not written by `ucfrec-control prepare`")
    return source


def preset_of(dataset: Mapping[str, Any], policy: str) -> Preset:
    """The preset of a learner on the dataset that `dataset_of` describes."""
    task = find_task(dataset["env_id"], dataset["dataset"])
    return find_preset(task.name if task else "", find_kind(dataset["dataset"]), policy)


def as_seen(store: EpisodeStore, dataset: Mapping[str, Any]) -> EpisodeStore:
    """What a policy sees of `store`, `dataset` being that of its run's record."""
    unseen = dataset.get(UNSEEN)
    return store.without_observation_dimensions(unseen) if unseen else store


def train_control(
    store: EpisodeStore, out: Path, config: Config, *, screening: str | None = None
) -> dict[str, Any]:
    """`ucfrec.runs.run.train_run` on a control store.

    Args:
        screening: screen the state's dimensions, and of those which cause nothing add copies that
            intervene on them ("copies"), or train as if they were not there ("drop").

    Raises:
        InputError: as `train_run`, the store is not a control store, or screening finds nothing in
            the state that causes anything.
    """
    dataset, copies = dict(dataset_of(store)), None
    about: dict[str, Any] = {"dataset": dataset, "versions": versions(PACKAGES)}
    begun = read_json(out / RUN) if (out / RUN).exists() else None
    if begun is not None and (before := _screening_of(begun["dataset"])) != screening:
        raise InputError(
            f"{out} was begun with{f' --screen {before}' if before else 'out --screen'}; name "
            "another run folder, or give the same options to resume"
        )
    if screening:
        key = SCREENINGS[screening]
        if begun is None:
            report = screen(store, ScreeningConfig(), config.seed)
            about["screening"] = asdict(report)
            dataset[key] = list(report.flagged)
            if len(report.flagged) == len(report.dimensions):
                raise InputError(
                    f"{store.path}: screening found no cause of anything among the "
                    f"{len(report.flagged)} state dimensions; {report.transitions:,} transitions "
                    "are too few, or too noisy, to tell: train without --screen"
                )
        else:
            dataset = begun["dataset"]
        if screening == "copies" and dataset[key]:
            copies = interventions(training_views(store)[0], dataset[key], config.seed)
    return train_run(as_seen(store, dataset), out, config, about, copies)


def _screening_of(dataset: Mapping[str, Any]) -> str | None:
    return next((name for name, key in SCREENINGS.items() if key in dataset), None)
