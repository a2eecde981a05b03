"""Training on a control store: presets beneath, the data's origin in the record."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ucfrec.config import Config
from ucfrec.errors import InputError
from ucfrec.files import read_json
from ucfrec.results import versions
from ucfrec.run import train_run, training_views
from ucfrec.store import EpisodeStore
from ucfrec.trained import RUN
from ucfrec_control.presets import Preset, find_preset
from ucfrec_control.scores import find_kind, find_task
from ucfrec_control.screening import ScreeningConfig, interventions, screen
from ucfrec_control.trajectories import PACKAGES


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


def train_control(
    store: EpisodeStore, out: Path, config: Config, *, screened: bool = False
) -> dict[str, Any]:
    """`ucfrec.run.train_run` on a control store.

    Args:
        screened: screen the state's dimensions and add copies that intervene on those which cause
            nothing.

    Raises:
        InputError: as `train_run`, or the store is not a control store.
    """
    dataset, copies = dict(dataset_of(store)), None
    about: dict[str, Any] = {"dataset": dataset, "versions": versions(PACKAGES)}
    begun = read_json(out / RUN) if (out / RUN).exists() else None
    if begun is not None and ("screening" in begun) != screened:
        raise InputError(
            f"{out} was begun {'with' if 'screening' in begun else 'without'} --screen; name "
            "another run folder, or give the same options to resume"
        )
    if screened:
        if begun is None:
            report = screen(store, ScreeningConfig(), config.seed)
            about["screening"] = asdict(report)
            dataset["screened"] = list(report.flagged)
        else:
            dataset = begun["dataset"]
        if dataset["screened"]:
            copies = interventions(training_views(store)[0], dataset["screened"], config.seed)
    return train_run(store, out, config, about, copies)
