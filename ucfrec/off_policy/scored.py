"""Scored rows of any number: written by workers of Spark, and the return that follows from them.

The rows are read twice, in batches, and summed to sessions, one row each in memory.
DM, FQE, DR and MIPS need the logs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array
from ucfrec.errors import InputError, one_line
from ucfrec.files.atomic import atomic_file, atomic_folder, require_file
from ucfrec.files.parquet import part_name, write_frames
from ucfrec.logs.mapping import LogMapping
from ucfrec.off_policy.answer import DAY_MS, Traffic
from ucfrec.off_policy.estimators import StepSums, normalise_by_step
from ucfrec.off_policy.evaluate import EstimateOptions, OffPolicyReport, WeighedLogs, make_report
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.off_policy.score import (
    PROBABILITY,
    SESSION,
    UNKNOWN_ITEMS,
    about_scores,
    hash_rows,
    prepare_sessions,
    require_items,
    score,
    seen_too_often,
    share_of_rows_seen,
    training_options,
)
from ucfrec.off_policy.verdict import MOST_LEFT_OUT
from ucfrec.runs.trained_policy import ITEMS, RunOnWorkers, TrainedPolicy

_BATCH_ROWS = 2**18
_TESTED_ROWS = 2**20
"""About so many rows are looked for in the training data."""
_KEYS = (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP)
_WEIGHED = (schema.USER_ID, SESSION, schema.REWARD, schema.PROPENSITY, PROBABILITY)


def evaluate_scored(
    trained: TrainedPolicy,
    paths: Sequence[Path],
    *,
    rule: DecisionRule,
    seed: int,
    options: EstimateOptions,
) -> OffPolicyReport:
    """Estimate the mean return of a session under a policy, from files of `score`, or
    folders of their parts.

    Raises:
        InputError: a file is missing, damaged, has no propensities, was scored by another run or
            rule, or is not in the order of `score`; or the options need the logs.
    """
    of_steps = (options.estimate_propensities, options.guardrails, options.by)
    if any(of_steps) or options.reward_range is not None:
        raise InputError(
            "estimated propensities, guardrails, groups and a reward range (of single "
            "steps) need the logs; leave --scored out"
        )
    files: list[Path] = []
    for path in map(Path, paths):
        files += sorted(path.glob("*.parquet")) if path.is_dir() else [path]
    if not files:
        raise InputError(f"{paths[0]} has no .parquet file; name what ucfrec score wrote")
    described = [_read_metadata(file, trained, rule) for file in files]
    rows = sum(metadata.num_rows for metadata in described)
    sessions = _sum_sessions(files, options)
    every, keys, clock = max(1, rows // _TESTED_ROWS), [], list[int]()
    for file in files:
        for batch in _read_batches(file, _KEYS):
            users, items, times = (batch[name][::every] for name in _KEYS)
            clock += [times.min(), times.max()]
            users, items = trained.users.numbers(users), trained.items.numbers(items)
            keys.append(hash_rows(users, items, times))
    seen = share_of_rows_seen(trained, np.concatenate(keys))
    logs = WeighedLogs(sessions, rows, {"seen_in_training": seen})
    logs.traffic = Traffic(days=float(np.ptp(clock)) / DAY_MS)
    logs.remarks.append("from scored rows: without models of the reward there is no DR")
    counts = [(metadata.metadata or {}).get(UNKNOWN_ITEMS.encode(), b"") for metadata in described]
    if not all(count.isdigit() for count in counts):
        logs.remarks.append(
            "rows of items that the run does not know are not part of scored rows; where the logs "
            "have many, estimate from the logs"
        )
    elif unknown := sum(map(int, counts)):
        # In the logs they weigh 0; here sessions lack them.
        much = unknown > MOST_LEFT_OUT * (rows + unknown)
        (logs.forbidden if much else logs.remarks).append(
            f"{unknown:,} of {rows + unknown:,} rows show items that the run does not know, and "
            "are not part of scored rows: estimate from the logs, where they weigh 0"
        )
    logs.forbidden += seen_too_often(seen)
    return make_report(trained, rule, logs, seed, options)


def _read_metadata(file: Path, trained: TrainedPolicy, rule: DecisionRule) -> pq.FileMetaData:
    """Metadata of a file that the run and rule scored."""
    require_file(file, "score the logs again")
    try:
        described = pq.read_metadata(file)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{file} cannot be read ({error})") from None
    columns = described.schema.names
    if missing := [name for name in (*_KEYS, *_WEIGHED) if name not in columns]:
        raise InputError(
            f"{file} has no column {', '.join(dict.fromkeys(missing))}; name what ucfrec score "
            "made of logs with propensities"
        )
    for name, value in about_scores(trained, rule).items():
        scored = (described.metadata or {}).get(name.encode(), b"").decode(errors="replace")
        if scored != value:
            raise InputError(
                f"{file} was scored with {name} {one_line(scored)!r:.80}, not {value!r}; name the "
                "same run, --checkpoint and decision rule as for ucfrec score"
            )
    return described


def _read_batches(file: Path, names: Sequence[str]) -> Iterator[dict[str, Array]]:
    try:
        with pq.ParquetFile(file) as source:
            for batch in source.iter_batches(_BATCH_ROWS, columns=list(names)):
                yield {name: batch.column(name).to_numpy(zero_copy_only=False) for name in names}
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{file} is damaged ({error}); write it with ucfrec score again") from None


def _read_whole_sessions(files: Sequence[Path]) -> Iterator[tuple[Path, dict[str, Array]]]:
    """The rows that are weighed, in batches that end where a session does; with their file."""
    held: dict[str, Array] = {}
    for file in files:
        for rows in _read_batches(file, _WEIGHED):
            if held:
                rows = {name: np.concatenate([held[name], rows[name]]) for name in rows}
            # The last session may go on.
            end = np.searchsorted(rows[SESSION], rows[SESSION][-1])
            if end:
                yield file, {name: values[:end] for name, values in rows.items()}
            held = {name: values[end:].copy() for name, values in rows.items()}
    if held:
        yield files[-1], held


def _read_steps(files: Sequence[Path], discount: float) -> Iterator[tuple[LoggedSteps, Array]]:
    """The sessions of all files, in order, some at once; with each session's user (S,)."""
    session = -1
    for file, rows in _read_whole_sessions(files):
        rises = np.diff(rows[SESSION], prepend=session)
        if rises[0] != 1 or not np.isin(rises, (0, 1)).all():
            raise InputError(
                f"{file}: sessions are not numbered in order; give all files of ucfrec score as it "
                "wrote them, none twice"
            )
        try:
            steps = LoggedSteps(
                rows[SESSION] - rows[SESSION][0],
                reward=rows[schema.REWARD],
                propensity=rows[schema.PROPENSITY],
                target=rows[PROBABILITY],
                discount=discount,
            )
        except InputError as error:
            raise InputError(f"{file}: {error}; name what ucfrec score wrote, unchanged") from None
        yield steps, rows[schema.USER_ID][rises == 1]
        session = rows[SESSION][-1]


def _sum_sessions(files: Sequence[Path], options: EstimateOptions) -> LoggedSteps:
    """Each session as one step, with its return, weight (unknown as its propensities are), and the
    terms of PDIS and SNPDIS."""
    sums: StepSums | None = None
    for steps, _ in _read_steps(files, options.discount):
        if not steps.lacking.all():
            part = StepSums.of(steps.weighable, steps.weighable.reward)
            sums = part if sums is None else sums + part
    parts = []
    for steps, users in _read_steps(files, options.discount):
        complete = ~steps.lacking
        weights = np.full(len(complete), np.nan)
        per_decision, by_step = np.zeros((2, len(complete)))
        if complete.any() and sums is not None:
            some = steps.weighable
            weights[complete] = some.session_weights
            per_decision[complete] = some.per_session(some.discounts * some.weights * some.reward)
            if sums.totals.all():
                by_step[complete] = normalise_by_step(some, some.reward, None, sums)
        values = {"returns": steps.returns, "per_decision": per_decision, "by_step": by_step}
        parts.append(pd.DataFrame({"user": users, "weight": weights, **values}))
    if not parts:
        raise InputError(f"{files[0]} has no rows; give logs with rows of known items to score")
    rows = pd.concat(parts, ignore_index=True)
    weights = rows["weight"].to_numpy()
    heaviest = np.fmax(weights, 1.0)
    return LoggedSteps(
        session=np.arange(len(rows)),
        reward=rows["returns"].to_numpy(),
        propensity=np.where(np.isnan(weights), np.nan, 1 / heaviest),
        target=np.nan_to_num(weights) / heaviest,
        user=rows["user"].to_numpy() if options.users_known else None,
        per_decision=rows["per_decision"].to_numpy(),
        by_step=rows["by_step"].to_numpy(),
    )


def score_with_spark(
    trained: TrainedPolicy,
    files: Sequence[Path],
    mapping: LogMapping,
    out: Path,
    master: str,
    *,
    checkpoint: str = "best",
    rule: DecisionRule | None = None,
    memory_limit: str = "2GB",
) -> int:
    """Write the probability of every choice of logs, as `score` finds it, to Parquet parts in the
    folder `out`, sessions numbered throughout; returns how many sessions there are.

    Args:
        files: logs, which every worker sees, as the run folder and `out`.
        master: Spark's master, e.g. "local[*]" or "spark://host:7077".
        checkpoint: with which `trained` was loaded.
        memory_limit: of a worker while it reads its rows.

    Raises:
        InputError: the policy's actions are vectors, the logs cannot be used, or Spark is missing
            or fails.
    """
    from ucfrec.logs.spark import UserLog, map_users

    require_items(trained)
    columns, options = training_options(trained, mapping)
    assert options.reward is not None
    log = UserLog(files, columns, options.reward, options.session_by, trained.folder / ITEMS)
    with atomic_folder(out) as folder:
        run = RunOnWorkers(trained.folder.absolute(), checkpoint, trained.fingerprint)
        rule = rule or trained.rule
        score_part = partial(_score_part, run, folder.absolute(), memory_limit, rule)
        sessions = map_users(log, folder.parent, master, score_part)
        number_sessions(folder, sessions)
    return sum(sessions)


def _score_part(
    run: RunOnWorkers,
    folder: Path,
    memory_limit: str,
    rule: DecisionRule,
    part: int,
    rows: Path,
    mapping: LogMapping,
) -> int:
    """Write the file of a part, with sessions numbered from 0; returns their number. A worker calls
    it (`ucfrec.logs.spark.Work`)."""
    trained = run.load()
    _, options = training_options(trained, mapping, memory_limit)
    options = replace(options, reward=schema.REWARD)
    with prepare_sessions(trained, [rows], mapping, options) as logged:
        frames = score(trained, logged, rule)
        write_frames(folder / part_name(part), frames, about_scores(trained, rule))
        return logged.store.n_episodes


def number_sessions(folder: Path, sessions: Sequence[int]) -> None:
    """Number the sessions of all parts in a row, given how many each of the parts has."""
    first = 0
    for file, count in zip(sorted(folder.iterdir()), sessions, strict=True):
        with atomic_file(file) as scratch, pq.ParquetFile(file) as source:
            place = source.schema_arrow.get_field_index(SESSION)
            with pq.ParquetWriter(scratch, source.schema_arrow) as writer:
                for batch in source.iter_batches():
                    numbers = pc.add(batch.column(place), pa.scalar(first, pa.int64()))
                    writer.write_batch(batch.set_column(place, SESSION, numbers))
        first += count
