"""The return of a policy, estimated from the rows that `ucfrec score` wrote, of any number.

The rows are read twice, in batches, and summed to sessions: in memory is a row a session. What
needs models of the reward (DM, FQE, DR) or the probabilities of other items (MIPS) needs the logs.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError, one_line
from ucfrec.files.parquet import require_regular
from ucfrec.off_policy.diagnostics import MOST_LEFT_OUT
from ucfrec.off_policy.estimators import StepSums, normalise_by_step
from ucfrec.off_policy.evaluate import Doubts, EstimateOptions, OffPolicyReport, make_report
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.off_policy.score import (
    PROBABILITY,
    SESSION,
    UNKNOWN_ITEMS,
    about_scores,
    hash_rows,
    seen_too_often,
    share_of_rows_seen,
)
from ucfrec.runs.trained_policy import TrainedPolicy

_BATCH_ROWS: Final = 2**18
_TESTED_ROWS: Final = 2**20
"""About so many rows are looked for in the training data."""
_KEYS: Final = (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP)
_WEIGHED: Final = (schema.USER_ID, SESSION, schema.REWARD, schema.PROPENSITY, PROBABILITY)


def evaluate_scored(
    trained: TrainedPolicy,
    paths: Sequence[Path],
    *,
    rule: DecisionRule,
    seed: int,
    options: EstimateOptions,
) -> OffPolicyReport:
    """Estimate the mean return of a session under a policy, from what `score` made of logs.

    Args:
        paths: files of `score`, or folders of their parts.
        rule: the decision rule, by which the rows were scored.
        seed: of the bootstrap.

    Raises:
        InputError: a file is missing, damaged, has no propensities, was scored by another run or
            rule, or is not in the order of `score`; or the options need the logs.
    """
    if options.pages or options.estimate_propensities or options.reward_range is not None:
        raise InputError(
            "pages, estimated propensities and a reward range (of single steps) need the logs; "
            "leave --scored out"
        )
    files = [
        file
        for path in map(Path, paths)
        for file in (sorted(path.glob("*.parquet")) if path.is_dir() else [path])
    ]
    if not files:
        raise InputError(f"{paths[0]} has no .parquet file; name what ucfrec score wrote")
    described = [_check_file(file, about_scores(trained, rule)) for file in files]
    rows = sum(metadata.num_rows for metadata in described)
    sessions = _sum_sessions(files, options)
    seen = _share_seen(trained, files, rows)
    doubts = Doubts(remarks=["from scored rows: without models of the reward there is no DR"])
    counts = [(metadata.metadata or {}).get(UNKNOWN_ITEMS.encode(), b"") for metadata in described]
    if not all(count.isdigit() for count in counts):
        doubts.remarks.append(
            "rows of items that the run does not know are not part of scored rows; where the logs "
            "have many, estimate from the logs"
        )
    elif unknown := sum(map(int, counts)):
        # In the logs they weigh 0; here sessions lack them.
        much = unknown > MOST_LEFT_OUT * (rows + unknown)
        (doubts.forbidden if much else doubts.remarks).append(
            f"{unknown:,} of {rows + unknown:,} rows show items that the run does not know, and "
            "are not part of scored rows: estimate from the logs, where they weigh 0"
        )
    doubts.forbidden += seen_too_often(seen)
    columns = {"seen_in_training": seen}
    return make_report(
        trained, rule, sessions, seed, options, rows=rows, doubts=doubts, columns=columns
    )


def _check_file(file: Path, about: Mapping[str, str]) -> pq.FileMetaData:
    """The metadata of a file that the run and rule scored."""
    require_regular(file)
    try:
        described = pq.read_metadata(file)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{file} cannot be read ({one_line(str(error)):.200})") from None
    columns = described.schema.names
    if missing := [name for name in (*_KEYS, *_WEIGHED) if name not in columns]:
        raise InputError(
            f"{file} has no column {', '.join(dict.fromkeys(missing))}; name what ucfrec score "
            "made of logs with propensities"
        )
    for name, value in about.items():
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
        raise InputError(
            f"{file} is damaged ({one_line(str(error)):.200}); write it with ucfrec score again"
        ) from None


def _read_whole_sessions(files: Sequence[Path]) -> Iterator[tuple[Path, dict[str, Array]]]:
    """The rows that are weighed, in batches that end where a session does; with their last file."""
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


def _read_steps(files: Sequence[Path], discount: float) -> Iterator[tuple[LoggedSteps, IntArray]]:
    """The sessions of all files, in order, some at once; with the number (S,) of each session's
    user, over all of them.

    Raises:
        InputError: they are not in the order in which `score` writes them, or a reward or a
            probability is none.
    """
    session, user, users = -1, None, 0
    for file, rows in _read_whole_sessions(files):
        rises = np.diff(rows[SESSION], prepend=session)
        if rises[0] != 1 or not np.isin(rises, (0, 1)).all():
            raise InputError(
                f"{file}: sessions are not numbered in order; give all files of ucfrec score as it "
                "wrote them, none twice"
            )
        owners = rows[schema.USER_ID][rises == 1]
        new = np.append(owners[0] != user, owners[1:] != owners[:-1])
        numbers = users - 1 + np.cumsum(new)
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
        yield steps, numbers
        session, user, users = rows[SESSION][-1], owners[-1], int(numbers[-1]) + 1


def _sum_sessions(files: Sequence[Path], options: EstimateOptions) -> LoggedSteps:
    """Each session as one step, with its return, weight (unknown as its propensities are), and the
    terms of PDIS and SNPDIS."""
    sums: StepSums | None = None
    for steps, _ in _read_steps(files, options.discount):
        if not steps.lacking.all():
            own = StepSums.of(steps.weighable, steps.weighable.reward)
            sums = own if sums is None else sums + own
    columns: list[tuple[Array, ...]] = []
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
        columns.append((users, steps.returns, weights, per_decision, by_step))
    if not columns:
        raise InputError(f"{files[0]} has no rows; give logs with rows of known items to score")
    users, returns, weights, per_decision, by_step = map(np.concatenate, zip(*columns, strict=True))
    heaviest = np.fmax(weights, 1.0)
    return LoggedSteps(
        session=np.arange(len(users)),
        reward=returns,
        propensity=np.where(np.isnan(weights), np.nan, 1 / heaviest),
        target=np.nan_to_num(weights) / heaviest,
        user=users if options.users_known else None,
        per_decision=per_decision,
        by_step=by_step,
    )


def _share_seen(trained: TrainedPolicy, files: Sequence[Path], rows: int) -> float | None:
    """About the share of rows that are in the run's training or validation data."""
    every, keys = max(1, rows // _TESTED_ROWS), []
    for file in files:
        for batch in _read_batches(file, _KEYS):
            users, items, times = (batch[name][::every] for name in _KEYS)
            numbers = trained.users.numbers(users), trained.items.numbers(items)
            keys.append(hash_rows(*numbers, times))
    return share_of_rows_seen(trained, np.concatenate(keys))
