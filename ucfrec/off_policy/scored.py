"""The return of a policy, estimated from the rows that `ucfrec score` wrote, of any number.

The rows are read twice, in batches, and summed to sessions: in memory is a row a session. What
needs models of the reward (DM, FQE, DR) or the probabilities of other items (MIPS) needs the logs.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.errors import InputError, one_line
from ucfrec.files.parquet import require_regular
from ucfrec.logs.spool import whole_groups
from ucfrec.off_policy.columns import Subject, diagnosis_columns, verdict_columns
from ucfrec.off_policy.diagnostics import diagnose
from ucfrec.off_policy.estimators import StepSums, estimate, normalised_by_step
from ucfrec.off_policy.evaluate import EstimateOptions, OffPolicyReport, conditions, of_sessions
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.off_policy.score import PROBABILITY, SESSION, UNKNOWN_ITEMS, about_scores
from ucfrec.off_policy.training_rows import row_keys, seen_too_often, share_of_rows_seen
from ucfrec.off_policy.verdict import MOST_LEFT_OUT, cautions, conclude
from ucfrec.runs.trained_policy import TrainedPolicy

_BATCH_ROWS: Final = 2**18
_TESTED_ROWS: Final = 2**20
"""About so many rows are looked for in the training data."""
_USED: Final = (
    *(schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP),
    *(SESSION, schema.REWARD, schema.PROPENSITY, PROBABILITY),
)
_WHOLE: Final = (schema.TIMESTAMP, SESSION)
_NUMBERS: Final = (schema.REWARD, schema.PROPENSITY, PROBABILITY)
_WEIGHED: Final = (schema.USER_ID, SESSION, schema.REWARD, schema.PROPENSITY, PROBABILITY)
_NO_DR: Final = "from scored rows: without models of the reward there is no DR"


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
    if options.pages or options.estimate_propensities:
        raise InputError("pages and estimated propensities need the logs; leave --scored out")
    if options.reward_range is not None:
        raise InputError("a reward range is of single steps and needs the logs; leave --scored out")
    files = _files(paths, about_scores(trained, rule))
    sessions = _summed(files, options)
    steps = sum(pq.read_metadata(file).num_rows for file in files)
    seen = _share_seen(trained, files, steps)
    found, diagnosis = estimate(sessions, seed), diagnose(sessions)
    forbidden, notes = _of_unknown_items(files, steps)
    forbidden += seen_too_often(seen)
    verdict = conclude(sessions, seed, diagnosis, options.wanted_lift, forbidden)
    warnings = [*verdict.reasons, *cautions(diagnosis, found), _NO_DR, *notes]
    about = {
        "seen_in_training": seen,
        "warnings": warnings,
        **verdict_columns(verdict),
        **diagnosis_columns(diagnosis),
    }
    read = conditions(trained.folder, len(sessions.first), steps, options)
    rows = Subject(trained, rule, seed, None, read, about).rows(found)
    return OffPolicyReport(
        rows, warnings, verdict, None, *of_sessions(sessions, diagnosis, verdict)
    )


def _files(paths: Sequence[Path], about: Mapping[str, str]) -> list[Path]:
    """The files, in the order of their rows; checks what scored them."""
    files = [
        file
        for path in map(Path, paths)
        for file in (sorted(path.glob("*.parquet")) if path.is_dir() else [path])
    ]
    if not files:
        raise InputError(f"{paths[0]} has no .parquet file; name what ucfrec score wrote")
    for file in files:
        require_regular(file)
        try:
            columns = pq.read_schema(file)
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{file} cannot be read ({one_line(str(error)):.200})") from None
        if lacking := [name for name in _USED if name not in columns.names]:
            raise InputError(
                f"{file} has no column {', '.join(lacking)}; name what ucfrec score made of logs "
                "with propensities"
            )
        for names, fits, kind in (
            (_WHOLE, pa.types.is_integer, "whole numbers"),
            (_NUMBERS, pa.types.is_floating, "floating point numbers"),
        ):
            for name in names:
                if not fits(columns.field(name).type):
                    raise InputError(
                        f"{file}: column {name} has type {columns.field(name).type}, not {kind}; "
                        "name what ucfrec score wrote, unchanged"
                    )
        metadata = columns.metadata or {}
        for name, value in about.items():
            if (scored := metadata.get(name.encode(), b"").decode(errors="replace")) != value:
                raise InputError(
                    f"{file} was scored with {name} {one_line(scored)!r:.80}, not {value!r}; name "
                    "the same run, --checkpoint and decision rule as for ucfrec score"
                )
    return files


def _of_unknown_items(files: Sequence[Path], rows: int) -> tuple[list[str], list[str]]:
    """What rows of items that the run does not know forbid, and what to know of them: sessions
    lack them, where in the logs they weigh 0.

    Args:
        rows: number of scored rows.
    """
    metadata = [pq.read_schema(file).metadata or {} for file in files]
    counts = [each.get(UNKNOWN_ITEMS.encode(), b"") for each in metadata]
    if not all(count.isdigit() for count in counts):
        return [], [
            "rows of items that the run does not know are not part of scored rows; where the logs "
            "have many, estimate from the logs"
        ]
    unknown = sum(map(int, counts))
    said = (
        f"{unknown:,} of {rows + unknown:,} rows show items that the run does not know, and are "
        "not part of scored rows: estimate from the logs, where they weigh 0"
    )
    if unknown > MOST_LEFT_OUT * (rows + unknown):
        return [said], []
    return [], [said] if unknown else []


def _batches(files: Sequence[Path], names: Sequence[str]) -> Iterator[dict[str, Array]]:
    for file in files:
        try:
            with pq.ParquetFile(file) as source:
                for batch in source.iter_batches(_BATCH_ROWS, columns=list(names)):
                    columns = {name: batch.column(name) for name in names}
                    yield {n: each.to_numpy(zero_copy_only=False) for n, each in columns.items()}
        except (pa.ArrowException, OSError) as error:
            raise InputError(
                f"{file} is damaged ({one_line(str(error)):.200}); write it with ucfrec score again"
            ) from None


def _chunks(files: Sequence[Path], discount: float) -> Iterator[tuple[LoggedSteps, IntArray]]:
    """The sessions of all files, in order, some whole ones at once; with the number (S,) of each
    session's user, over all of them.

    Raises:
        InputError: they are not in the order in which `score` writes them.
    """
    session, user, users = -1, None, 0
    for rows in whole_groups(_weighed(files), SESSION):
        rises = np.diff(rows[SESSION], prepend=session)
        if rises[0] != 1 or not np.isin(rises, (0, 1)).all():
            raise InputError(
                f"{files[0]}: sessions are not numbered in order; give all files of ucfrec score "
                "as it wrote them, none twice"
            )
        owners = rows[schema.USER_ID][rises == 1]
        new = np.append(owners[0] != user, owners[1:] != owners[:-1])
        numbers = users - 1 + np.cumsum(new)
        yield _steps(rows, rows[SESSION] - rows[SESSION][0], discount), numbers
        session, user, users = rows[SESSION][-1], owners[-1], int(numbers[-1]) + 1


def _weighed(files: Sequence[Path]) -> Iterator[dict[str, Array]]:
    """The rows of all files that are weighed.

    Raises:
        InputError: a reward or probability is none; names the file and its rows.
    """
    for file in files:
        done = 0
        for rows in _batches([file], _WEIGHED):
            begin, done = done, done + len(rows[SESSION])
            try:
                _steps(rows, np.arange(done - begin))
            except InputError as error:
                raise InputError(
                    f"{file}, rows {begin + 1:,} to {done:,}: {error}; name what ucfrec score "
                    "wrote, unchanged"
                ) from None
            yield rows


def _steps(rows: Mapping[str, Array], session: IntArray, discount: float = 1.0) -> LoggedSteps:
    return LoggedSteps(
        session,
        reward=rows[schema.REWARD],
        propensity=rows[schema.PROPENSITY],
        target=rows[PROBABILITY],
        discount=discount,
    )


def _summed(files: Sequence[Path], options: EstimateOptions) -> LoggedSteps:
    """Each session as one step, with the session's return, weight and terms of the estimates."""
    chunks = partial(_chunks, files, options.discount)
    sums: StepSums | None = None
    for steps, _ in chunks():
        if not steps.lacking.all():
            known = steps.known()
            own = StepSums.of(known, known.reward)
            sums = own if sums is None else sums + own
    parts = [(users, *_terms(steps, sums)) for steps, users in chunks()]
    if not parts:
        raise InputError(f"{files[0]} has no rows; give logs with rows of known items to score")
    users, returns, weights, per_decision, by_step = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
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


def _terms(
    steps: LoggedSteps, sums: StepSums | None
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """(S,) returns, weights (NaN where a propensity is unknown), and the terms of PDIS and SNPDIS
    (0 there).

    Args:
        sums: of all sessions with all their propensities; None if there are none.
    """
    there = ~steps.lacking
    weights = np.full(len(there), np.nan)
    per_decision, by_step = np.zeros((2, len(there)))
    if there.any() and sums is not None:
        known = steps.known()
        weights[there] = known.session_weights
        per_decision[there] = known.per_session(known.discounts * known.weights * known.reward)
        if sums.totals.all():
            by_step[there] = normalised_by_step(known, known.reward, None, sums)
    return steps.returns, weights, per_decision, by_step


def _share_seen(trained: TrainedPolicy, files: Sequence[Path], rows: int) -> float | None:
    """About the share of rows that are in the run's training or validation data."""
    every, keys = max(1, rows // _TESTED_ROWS), []
    for batch in _batches(files, (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP)):
        some = {name: values[::every] for name, values in batch.items()}
        users = trained.users.numbers(some[schema.USER_ID])
        items = trained.items.numbers(some[schema.ITEM_ID])
        keys.append(row_keys(users, items, some[schema.TIMESTAMP]))
    return share_of_rows_seen(trained, np.concatenate(keys))
