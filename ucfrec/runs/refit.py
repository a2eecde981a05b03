"""Train once more on all rows, once everything has been chosen."""

import dataclasses
import shutil
from pathlib import Path

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting import distributed
from ucfrec.runs.config import Config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import INPUTS, REWARD_MODEL, RULE, TrainedPolicy
from ucfrec.user_model.model import SESSIONS
from ucfrec.user_model.reward_fit import refit_item_reward_model


def refit(store: EpisodeStore, first: Path, out: Path) -> RunRecord:
    """Train a policy as the run `first`, but on its validation and test episodes too.

    Nothing is chosen again: the settings, the number of steps (those of the best weights of
    `first`), the strength of the reward model's effects and the decision rule are those of `first`.
    Item embeddings stay those of the store's training split. There is nothing left to evaluate the
    policy on but later logs.

    Args:
        store: the store of `first`.
        first: a finished run.
        out: run folder, new or interrupted.

    Returns:
        The record of the new run.

    Raises:
        InputError: `first` is not a finished run on this store, or `out` is another run.
    """
    trained = TrainedPolicy.load(first)
    if not trained.record.is_of(store.record):
        raise InputError(
            f"{first} was trained on another store than {store.path}; name the store of the run"
        )
    if trained.record.policy is None:
        raise InputError(f"{first} is not finished; train it to its end first")
    about = {
        "refit_of": trained.record.settings | {"rule": trained.rule.as_dict()},
        "dropped_observations": trained.dropped,
    }
    if trained.dropped:
        store = store.without_observation_dimensions(trained.dropped)
    record = train_run(store, out, _settings(trained), about, on_all_rows=True)
    if not distributed.leads():
        return record
    record = record.reopened(out, INPUTS)
    shutil.copyfile(first / RULE, out / RULE)
    if trained.reward_model is not None:
        refit_item_reward_model(first / REWARD_MODEL, store, out / REWARD_MODEL, record.seed)
        if (first / REWARD_MODEL / SESSIONS).exists():
            shutil.copyfile(first / REWARD_MODEL / SESSIONS, out / REWARD_MODEL / SESSIONS)
    return record.sealed(out)


def _settings(trained: TrainedPolicy) -> Config:
    """The settings of a run, for as many steps as its best weights took, and no new choice."""
    config = trained.record.config
    steps = max(1, trained.record.finished.best_step)
    return dataclasses.replace(
        config,
        train=dataclasses.replace(config.train, steps=steps, patience=0),
        rule=dataclasses.replace(config.rule, choose=False),
    )
