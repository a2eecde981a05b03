"""Go on learning from all rows, once everything has been chosen."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.fitting import distributed
from ucfrec.provenance import config_hash
from ucfrec.runs.record import REFIT, RUN, RunRecord, place_of, refit_of_run
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import INPUTS, REWARD_MODEL, RULE, TrainedPolicy
from ucfrec.user_model.reward_fit import refit_item_reward_model
from ucfrec.user_model.session_end import SESSIONS


def refit(store: EpisodeStore, first: Path, out: Path) -> RunRecord:
    """Go on training the policy of the finished run `first`, on all episodes of its store.

    Nothing is chosen again: the settings, the augmented episodes, the strength of the reward
    model's effects and the decision rule are those of `first`. The best weights are trained for as
    many steps as the training had, or where items come and go as these weights had, while the
    learning rate falls to 0; policies that are fitted without gradients are fitted again. Item
    embeddings stay those of the store's training split. There is nothing left to evaluate the
    policy on but later logs. InputError if `first` is not a finished run on this store, or `out` is
    another run.

    Args:
        out: run folder, new or interrupted; `first / REFIT` for the weights that `first` acts by.
    """
    trained = TrainedPolicy.load(first, split=True)
    if not trained.record.is_of(store.record):
        raise InputError(
            f"{first} was trained on another store than {store.path}; name the store of the run"
        )
    if trained.record.policy is None:
        raise InputError(f"{first} is not finished; train it to its end first")
    names = ("dropped_observations", "augmentation", "extra", "update")
    entries: dict[str, Any] = {name: getattr(trained.record, name) for name in names}
    entries["refit_of"] = _identity(trained)
    if out == first / REFIT:
        entries |= place_of(store.path, first)
    chosen, has_reward_model = trained.record, trained.reward_model is not None
    del trained  # the memory of its items, which the training needs
    if chosen.dropped_observations:
        store = store.without_observation_dimensions(chosen.dropped_observations)
    config = chosen.config
    # Items that come and go are soon known too well.
    steps = chosen.finished.best_step if store.has_offers else chosen.finished.steps
    warmup = min(config.train.warmup, steps // 10)
    train = replace(config.train, steps=steps, warmup_steps=warmup, cosine=True, patience=0)
    config = replace(config, train=train, rule=replace(config.rule, choose=False))
    record = train_run(store, out, config, entries, refit_of=first)
    if not distributed.leads():
        return record
    record = record.reopen(out, INPUTS)
    shutil.copyfile(first / RULE, out / RULE)
    if has_reward_model:
        refit_item_reward_model(first / REWARD_MODEL, store, out / REWARD_MODEL, record.seed)
        if (first / REWARD_MODEL / SESSIONS).exists():
            shutil.copyfile(first / REWARD_MODEL / SESSIONS, out / REWARD_MODEL / SESSIONS)
    return record.copy_with(rule=chosen.rule, reward_model=chosen.reward_model).seal(out)


def refit_within(store: EpisodeStore, run: Path) -> RunRecord:
    """`refit` a run into its own folder, which then acts by the new weights; made once.

    A refit of other weights than those of the run is made again. InputError if the run is not
    finished.
    """
    out = run / REFIT
    if (out / RUN).exists():
        first = TrainedPolicy.load(run, split=True)
        if config_hash(RunRecord.read(out).refit_of or {}) != config_hash(_identity(first)):
            shutil.rmtree(out)
        elif (record := refit_of_run(run, first.record)) is not None:
            return record
    return refit(store, run, out)


def _identity(trained: TrainedPolicy) -> dict[str, Any]:
    """Settings, rule and weights of a run."""
    rule, weights = trained.rule.as_dict(), trained.fingerprint
    return {**trained.record.settings, "rule": rule, "weights": weights}
