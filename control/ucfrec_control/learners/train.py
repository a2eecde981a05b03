"""Training on a control store, with presets and screening."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ucfrec.counterfactual.interventions import interventions
from ucfrec.counterfactual.screening import ScreeningConfig, screen
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.provenance import versions
from ucfrec.runs.config import Config
from ucfrec.runs.run import train_run, training_views
from ucfrec.runs.trained_policy import RUN
from ucfrec_control.data.trajectories import PACKAGES
from ucfrec_control.learners.presets import Preset, find_preset
from ucfrec_control.worlds.scores import find_kind, find_task

DROPPED_DIMENSIONS = "unseen"
SCREENINGS = {"copies": "screened", "drop": DROPPED_DIMENSIONS}
"""How dimensions without effect are treated, and the key of `dataset` in a run's record that lists
them."""


def dataset_of(store: EpisodeStore) -> Mapping[str, Any]:
    """The `source` of a control store: dataset, environment and versions.

    Raises:
        InputError: `store` is not a control store.
    """
    source: Mapping[str, Any] = store.meta["source"]
    if "env_id" not in source:
        raise InputError(
            f"{store.path} is not a control store; write one with `ucfrec-control prepare`"
        )
    return source


def preset_of(dataset: Mapping[str, Any], policy: str) -> Preset:
    """The preset of a learner on the dataset that `dataset_of` describes."""
    task = find_task(dataset["env_id"], dataset["dataset"])
    return find_preset(task.name if task else "", find_kind(dataset["dataset"]), policy)


def without_dropped(store: EpisodeStore, dataset: Mapping[str, Any]) -> EpisodeStore:
    """`store` without the dimensions that `dataset`, of a run's record, lists as dropped."""
    dropped = dataset.get(DROPPED_DIMENSIONS)
    return store.without_observation_dimensions(dropped) if dropped else store


def train_control(
    store: EpisodeStore, out: Path, config: Config, *, screening: str | None = None
) -> dict[str, Any]:
    """`ucfrec.runs.run.train_run` on a control store.

    Args:
        store: a control store.
        out: run folder; an interrupted run resumes.
        config: of the training.
        screening: None, or how to treat state dimensions that screening finds without effect: add
            copies of the episodes that intervene on them ("copies"), or train without these
            dimensions ("drop").

    Returns:
        The run's record.

    Raises:
        InputError: as `train_run`; the store is not a control store; the run was started with
            another `screening`; or screening finds no dimension with an effect.
    """
    dataset, copies = dict(dataset_of(store)), None
    record: dict[str, Any] = {"dataset": dataset, "versions": versions(PACKAGES)}
    started = read_json(out / RUN) if (out / RUN).exists() else None
    if started is not None and (before := _screening_of(started["dataset"])) != screening:
        raise InputError(
            f"{out} was started with{f' --screen {before}' if before else 'out --screen'}; name "
            "another run folder, or give the same options to resume"
        )
    if screening:
        key = SCREENINGS[screening]
        if started is None:
            report = screen(training_views(store)[0], ScreeningConfig(), config.seed)
            record["screening"] = asdict(report)
            dataset[key] = list(report.flagged)
            if len(report.flagged) == len(report.dimensions):
                raise InputError(
                    f"{store.path}: screening found no effect of any of the "
                    f"{len(report.flagged)} state dimensions; {report.transitions:,} transitions "
                    "are too few, or too noisy, to tell: train without --screen"
                )
        else:
            dataset = started["dataset"]
        if screening == "copies" and dataset[key]:
            copies = interventions(training_views(store)[0], dataset[key], config.seed)
    return train_run(without_dropped(store, dataset), out, config, record, copies)


def _screening_of(dataset: Mapping[str, Any]) -> str | None:
    return next((name for name, key in SCREENINGS.items() if key in dataset), None)
