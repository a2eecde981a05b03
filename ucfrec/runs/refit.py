"""Train once more on all rows, once everything has been chosen."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.files.checksums import reopen, seal
from ucfrec.fitting import distributed
from ucfrec.runs.config import Config, config_from_dict
from ucfrec.runs.record import is_of_store
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import (
    DROPPED,
    INPUTS,
    REFIT_OF,
    REWARD_MODEL,
    RULE,
    RUN,
    TrainedPolicy,
)
from ucfrec.user_model.reward_fit import refit_item_reward_model


def refit(store: EpisodeStore, first: Path, out: Path) -> dict[str, Any]:
    """Train a policy as the run `first`, but on its validation and test episodes too.

    Nothing is chosen again: the settings, the number of steps (those of the best weights of
    `first`), the strength of the reward model's effects and the decision rule are those of `first`.
    Item embeddings stay those of the store's training split. There is nothing left to judge the
    policy on but later logs.

    Args:
        store: the store of `first`.
        first: a finished run.
        out: run folder, new or interrupted.

    Returns:
        The content of `run.json`.

    Raises:
        InputError: `first` is not a finished run on this store, or `out` is another run.
    """
    trained = TrainedPolicy.load(first)
    if not is_of_store(trained.record, store.meta):
        raise InputError(
            f"{first} was trained on another store than {store.path}; name the store of the run"
        )
    if "policy" not in trained.record:
        raise InputError(f"{first} is not finished; train it to its end first")
    about: dict[str, Any] = {REFIT_OF: trained.record["config"] | {"rule": trained.rule.as_dict()}}
    if trained.dropped:
        store = store.without_observation_dimensions(trained.dropped)
        about[DROPPED] = list(trained.dropped)
    record = train_run(store, out, _settings(trained), about, on_all_rows=True)
    if not distributed.leads():
        return record
    reopen(out, RUN, record, INPUTS)
    shutil.copyfile(first / RULE, out / RULE)
    if trained.reward_model is not None:
        refit_item_reward_model(first / REWARD_MODEL, store, out / REWARD_MODEL, record["seed"])
    return seal(out, RUN, read_json(out / RUN))


def _settings(trained: TrainedPolicy) -> Config:
    """The settings of a run, for so many steps as its best weights took, and no new choice."""
    config = config_from_dict(trained.record["config"])
    steps = max(1, int(trained.record["policy"]["best_step"]))
    return dataclasses.replace(
        config,
        train=dataclasses.replace(config.train, steps=steps, patience=0),
        rule=dataclasses.replace(config.rule, choose=False),
    )
