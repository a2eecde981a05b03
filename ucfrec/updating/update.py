"""Update a run with new logs: grow its store, train on from its weights, compare both runs."""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ucfrec import schema
from ucfrec.episodes.store import EpisodeStore, UserRows
from ucfrec.errors import InputError
from ucfrec.files.atomic import lock_path
from ucfrec.logs.append import AppendOptions, append_logs
from ucfrec.logs.mapping import LogMapping
from ucfrec.processes import random_state_kept
from ucfrec.runs.config import config_from_dict
from ucfrec.runs.record import RUN, STORE_SUFFIX, RunRecord, Update
from ucfrec.runs.refit import refit_within
from ucfrec.runs.run import train_run
from ucfrec.runs.start import warm_settings
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.updating.verdict import compare_runs, measure_drift


@dataclass(frozen=True)
class UpdateOptions:
    """How `update_run` updates."""

    append: AppendOptions = field(default_factory=AppendOptions)
    """How the store grows."""
    refit: bool = True
    """Go on learning from the newest rows, too, once the runs are compared; see
    `ucfrec.runs.refit`."""
    allow_argmax: bool = False
    """Let a decision rule that draws items become one that takes the best, after which new logs
    have no propensities to evaluate from."""


@random_state_kept()
def update_run(
    run: Path,
    paths: Sequence[str | Path],
    out: Path,
    *,
    store: Path | None = None,
    mapping: LogMapping | None = None,
    options: UpdateOptions | None = None,
) -> RunRecord:
    """Make a run that has learned from new logs, too; an interrupted update is resumed.

    The settings are those of the run. Its policy and augmentation models start from its weights,
    with fewer steps; effects of the user model and the decision rule are looked for near those of
    the run. The validation split is the second newest part of the new rows, the test split, on
    which the runs are compared, the newest. Once they are compared, the new run goes on learning
    from these rows, too. Neither the run nor its store is changed.

    Args:
        run: a finished run on a store of logs of items, which must be there.
        paths: new log files, folders and globs.
        out: folder of the new run, new or interrupted.
        store: folder of the grown store; None for one beside `out`, with `-store` added.
        mapping: as of `ucfrec.logs.append.append_logs`.

    Returns:
        The record of the new run; `update` has the drift of the new rows and the verdict.

    Raises:
        InputError: the run or the logs cannot be used, or `out` or `store` is something else.
    """
    options = options or UpdateOptions()
    trained = TrainedPolicy.load(run, split=True)
    if trained.item_states is None or trained.counts is None:
        raise InputError(f"{run}: the actions of this policy are vectors; train it again instead")
    if trained.record.policy is None:
        raise InputError(f"{run} is not finished; train it to its end first")
    remedy = "move the run together with its store, or prepare all logs and train again"
    store_before = trained.require_store(remedy)
    if os.path.lexists(out):
        previous = RunRecord.read(out).update if (out / RUN).is_file() else None
        if previous is None or previous.run != trained.fingerprint:
            raise InputError(f"{out} exists and is not an update of {run}; name another run folder")
    grown = store or out.with_name(out.name + STORE_SUFFIX)
    with lock_path(grown, "updated"):
        counts = append_logs(store_before.path, paths, grown, mapping, options.append)
    opened = EpisodeStore.open(grown)
    full = trained.record.config  # as a training from scratch had it
    if trained.record.update is not None:
        full = config_from_dict(trained.record.update.settings_from_nothing)
    elif (repeated := trained.record.refit_of) is not None:
        # In place of the settings of the rule's choice, it has the rule.
        settings = {k: v for k, v in repeated.items() if k not in ("rule", "weights")}
        full = replace(config_from_dict(settings), rule=replace(full.rule, choose=True))
    config = warm_settings(full)
    if (temperature := trained.rule.temperature) and not options.allow_argmax:
        drawing = tuple(value for value in config.rule.temperatures if value > 0)
        rule = replace(config.rule, temperatures=drawing or (temperature,))
        config = replace(config, rule=rule)
    update = Update(
        of=run.resolve().name,
        run=trained.fingerprint,
        settings_from_nothing=asdict(full),
        episodes=counts["episodes"],
        appended={name: count for name, count in counts.items() if type(count) is int}
        | {"not_newer": counts["dropped"]["clock_out_of_range"]},
    )
    record = train_run(opened, out, config, {"update": update}, initial=run)
    assert record.update is not None
    if record.update.verdict is None:
        added = opened.select(np.arange(opened.n_episodes)[-record.update.episodes :])
        training = store_before.split("train")
        seed = config.seed
        changes = measure_drift(trained, training, added, counts, seed)
        split = opened.episode_values(schema.SPLIT)
        newest = opened.split("test")
        earlier = opened.select(split != schema.SPLITS.index("test"))
        users = newest.episode_values(schema.USER)
        rows = UserRows.of(newest, users, earlier)
        new = TrainedPolicy.load(out, split=True)
        acting = TrainedPolicy.load(trained.folder)
        verdict = compare_runs(new, acting, rows, seed)
        update = record.update.model_copy(update={"drift": changes, "verdict": verdict})
        record = record.copy_with(update=update).write(out)
    if options.refit:
        refit_within(opened, out)
    return record
