"""Data as callers of the Python API give it: frames, files, stores."""

import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from numbers import Real
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import pandas as pd
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.episodes.record import StoreRecord
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.histories import Histories, log_table
from ucfrec.logs.mapping import Dataset, LogFiles, LogMapping, read_mapping
from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare
from ucfrec.logs.summary import MANY, note_dropped
from ucfrec.off_policy.score import LoggedSessions, held_out_sessions, read_logged_sessions
from ucfrec.plugins import load_plugin
from ucfrec.recommending.histories import histories_of_frame, select_users
from ucfrec.runs.later_logs import columns_used, later_logs, reward_of
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.settings import require_ids, shown

Logs = pd.DataFrame | LogFiles | Path | str | Sequence[str | Path]
"""A frame with one row per interaction; or files, folders and globs."""
Columns = LogMapping | Mapping[str, str] | str | Path
"""What the columns of logs mean, only the names of some, or a TOML file as of `--mapping`."""
Resolved = tuple[tuple[Path, ...], LogMapping]
"""Files of logs and what their columns mean."""
_FRAME = "frame.parquet"
_KEYS = (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP, schema.SESSION_ID)
_OPTIONS = (
    (r" or --max-session \d+", ""),
    (r"--column (\w+)=('[^']*'|\.\.\.)", r"mapping=LogMapping({'\1': \2})"),
    (r"--column (\w+)=", r"mapping=LogMapping({'\1': ''})"),
    (r"--where (\"[^\"]*\")", r"mapping=LogMapping(where=\1)"),
    (r"--time-format ('[^']*')", r"mapping=LogMapping(time_format=\1)"),
    (r"--earliest ([\d-]+)", r"mapping=LogMapping(earliest='\1')"),
    (r"--time-format", "LogMapping.time_format"),
    (r"--(where|earliest|partitions|column)", r"LogMapping.\1"),
    (r"--reward 1\b", "reward='1'"),
    (r"--(reward|liked|k)(?![\w-])", r"\1"),
    (r" with --out", ""),
    (r"--policy ([\w-]+)", r"policy='\1'"),
)
"""Options of commands in messages, and what they are in Python."""
_OUR_MODULES = re.compile(r"(ucfrec|contextlib)(\.|$)")
"""Modules whose lines a warning does not name."""


def require_logs(name: str, value: object) -> object:
    """Check that a value is a frame, files or a store. InputError if it is something else."""
    if not (_are_paths(value) or isinstance(value, (pd.DataFrame, LogFiles, EpisodeStore))):
        raise InputError(
            f"{name} is {shown(value)}; give a pandas DataFrame with one row per interaction, or "
            "files, folders or globs"
        )
    return value


def read_split(name: str, value: object) -> tuple[float, ...]:
    """A split as `PrepareOptions.split` has it, of shares or of times in any form. InputError if
    `value` is neither."""
    if not isinstance(value, Iterable):
        forms = "three shares, two times or 'leave-last-out'"
        raise InputError(f"{name} is {shown(value)}; give {forms}")
    parts = [value] if isinstance(value, str) else list(value)
    if all(isinstance(part, Real) for part in parts):
        return tuple(float(part) for part in parts)
    return parse_split(",".join(map(str, parts)))


def _read_columns(columns: Columns | None) -> LogMapping:
    if columns is None or isinstance(columns, LogMapping):
        return columns or LogMapping()
    if isinstance(columns, (str, Path)):
        return read_mapping(Path(columns))
    if isinstance(columns, Mapping) and all(isinstance(name, str) for name in columns.values()):
        return LogMapping(columns)
    raise InputError(
        f"mapping is {shown(columns)}; give a LogMapping, a TOML file, or a dictionary of log "
        "columns to columns of the data"
    )


def prepare_store(
    data: EpisodeStore | Logs,
    mapping: Columns | None,
    scratch: Path,
    options: Mapping[str, Any],
) -> EpisodeStore:
    """The store that `data` is, or one prepared from the logs in it.

    Args:
        data: a store or its folder, or logs.
        mapping: of the columns of logs; None for none.
        scratch: folder for the prepared store.
        options: fields of `PrepareOptions`, of logs.

    Raises:
        InputError: the data cannot be used, or `mapping` or `options` come with a store.
    """
    prepared = isinstance(data, (str, Path)) and (Path(data) / StoreRecord.FILE).is_file()
    if isinstance(data, EpisodeStore) or prepared:
        if options or mapping is not None:
            raise InputError(f"{data} is prepared already; prepare its logs with other options")
        return data if isinstance(data, EpisodeStore) else EpisodeStore.open(str(data))
    columns, dataset = _read_columns(mapping), options.get("dataset", "generic")
    if "dataset" in options and not _are_paths(data):
        raise InputError(f"dataset is {dataset!r}, but only files have one; leave it out")
    adapter: Dataset = load_plugin("datasets", dataset)
    files, columns, frame = _find_files(
        data, columns, adapter.resolve, scratch, columns, options.get("reward")
    )
    dataset = data.dataset if isinstance(data, LogFiles) else dataset
    with use_words_of_python(frame):
        how = PrepareOptions(**{**options, "dataset": dataset})
        _require_gap(options, how.session_by or columns.session_by)
        report = prepare(files, columns, scratch / "store", how)
        _require_gap(options, report["session_by"])
        _note_dropped(report, fine=())
    (scratch / _FRAME).unlink(missing_ok=True)
    return EpisodeStore.open(scratch / "store")


def _require_gap(options: Mapping[str, Any], session_by: str | None) -> None:
    """Refuse a gap that would count for nothing; None is for what the columns decide later."""
    if "gap_minutes" in options and session_by not in (None, "gap"):
        raise InputError(
            f"gap_minutes is {options['gap_minutes']:g}, but sessions are those of "
            f"session_by={session_by!r}; leave it out, or give session_by='gap'"
        )


def _note_dropped(report: Mapping[str, Any], **how: Any) -> None:
    """Warn of dropped rows, but for the reasons that `prepare` itself warns of."""
    dropped: Mapping[str, int] = report["dropped"]
    most = MANY * (report["rows_read"] - dropped["left_out"])
    counts = {name: n for name, n in dropped.items() if n <= most or name == "left_out"}
    note_dropped("", counts, report["rows_read"], **how)


@contextmanager
def read_logs(
    trained: TrainedPolicy,
    logs: Logs | None,
    mapping: Columns | None,
    keep_unknown: bool,
    measures: Sequence[str] = (),
    by: str | None = None,
) -> Iterator[LoggedSessions]:
    """Later logs of a policy, or None for the test split of its store.

    Args:
        mapping: of their columns; what it leaves open is as in the training log.
        keep_unknown: see `read_logged_sessions`, also for `measures` and `by`.

    Raises:
        InputError: the logs cannot be used.
    """
    if logs is None:
        if mapping is not None:
            raise InputError("mapping is of logs, and none are given; leave it out")
        yield held_out_sessions([trained])
        return
    with (
        open_files(trained, logs, mapping) as (files, columns, frame),
        use_words_of_python(frame),
        read_logged_sessions(
            trained, files, columns, keep_unknown, measures=measures, by=by
        ) as logged,
    ):
        _note_dropped(logged.report)
        yield logged


@contextmanager
def open_files(
    trained: TrainedPolicy, logs: Logs, mapping: Columns | None
) -> Iterator[tuple[tuple[Path, ...], LogMapping, Path | None]]:
    """Later logs of a policy as files: the files, the mapping, and the file of a frame, which lasts
    as long as the block; None for files. InputError if a path is missing, or the frame cannot be
    used."""
    columns = _read_columns(mapping)
    needed, reward = columns_used(trained, columns), reward_of(trained)
    with scratch_folder(Path(gettempdir()), "frame") as scratch:
        yield _find_files(logs, columns, partial(later_logs, trained), scratch, needed, reward)


def read_histories(
    trained: TrainedPolicy,
    frame: pd.DataFrame | None,
    mapping: Columns | None,
    users: Iterable[Any] | None,
    before_ms: int | None = None,
) -> Iterator[Histories]:
    """Histories of users before a time: of a frame, or None for what the store of the run has.
    InputError if the frame cannot be used, the store is gone, `users` is no list of ids, or one of
    them has no rows."""
    stored = frame is None
    ids = None if users is None else require_ids("users", users, schema.USER_ID)
    if frame is None:
        store = trained.require_store("give the histories of the users as a frame")
        if ids is not None:
            numbers = trained.users.numbers(ids)
            theirs = pd.Series(store.episode_values(schema.USER)).isin(numbers[numbers >= 0])
            if not theirs.any():
                raise InputError(f"none of the {len(ids):,} users is in the store of the run")
            store = store.select(theirs.to_numpy().nonzero()[0])
        columns = [schema.PROPENSITY, schema.IS_RANDOM, schema.SPLIT]
        frame = store.to_frame().drop(columns=columns, errors="ignore")
        mapping = LogMapping({name: name for name in _KEYS if name in frame})
    renamed = replace(_read_columns(mapping), before_ms=before_ms)
    histories = histories_of_frame(trained, frame, renamed, stored)
    return histories if ids is None else select_users(histories, ids)


def _find_files(
    logs: Any,
    columns: LogMapping,
    resolve: Callable[[Sequence[str | Path], LogMapping], Resolved],
    scratch: Path,
    needed: LogMapping,
    reward: str | None,
) -> tuple[tuple[Path, ...], LogMapping, Path | None]:
    """Files of logs, their mapping, and the file in `scratch` to which a frame is written: the
    columns that are `needed`, or that the `reward` reads."""
    if isinstance(logs, LogFiles):
        return logs.files, columns.over(logs.mapping), None
    if _are_paths(logs):
        paths = [logs] if isinstance(logs, (str, Path)) else list(logs)
        return *resolve(paths, columns), None
    file = scratch / _FRAME
    pq.write_table(log_table(logs, "data", needed, reward), file)
    return (file,), columns, file


def _are_paths(logs: object) -> bool:
    several = isinstance(logs, Sequence) and all(isinstance(path, (str, Path)) for path in logs)
    return isinstance(logs, (str, Path)) or several


@contextmanager
def use_words_of_python(file: Path | None = None) -> Iterator[None]:
    """Let errors and warnings of the block name arguments, not a scratch file or options.

    Args:
        file: scratch file of the argument `data`.
    """

    def translate(message: object) -> str:
        text = str(message) if file is None else str(message).replace(str(file), "data")
        for option, python in _OPTIONS:
            text = re.sub(option, python, text)
        return text

    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        try:
            yield
        except InputError as error:
            raise InputError(translate(error)) from None
    for note in notes:
        # The first line of the user's, above ours.
        level, frame = 1, sys._getframe()
        while frame.f_back and _OUR_MODULES.match(frame.f_globals.get("__name__", "")):
            level, frame = level + 1, frame.f_back
        warnings.warn(note.category(translate(note.message)), stacklevel=level)
