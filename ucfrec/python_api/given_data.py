"""Data as callers of the Python API give it: frames, files, stores."""

import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from numbers import Real
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final

import pandas as pd
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.arguments import require_ids, shown
from ucfrec.arrays import Array
from ucfrec.episodes.record import StoreRecord
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.histories import log_table
from ucfrec.logs.mapping import Dataset, LogFiles, LogMapping, read_mapping
from ucfrec.logs.prepare import PrepareOptions, parse_split, prepare
from ucfrec.logs.summary import MANY, note_dropped
from ucfrec.off_policy.score import LoggedSessions, held_out_sessions, read_logged_sessions
from ucfrec.plugins import load_plugin
from ucfrec.recommending.histories import Histories, histories_of_frame, select_users
from ucfrec.runs.later_logs import later_logs
from ucfrec.runs.trained_policy import TrainedPolicy

Logs = pd.DataFrame | LogFiles | Path | str | Sequence[str | Path]
"""A frame with one row per interaction; or files, folders and globs."""
Columns = LogMapping | Mapping[str, str] | str | Path
"""What the columns of logs mean, only the names of some, or a TOML file as of `--mapping`."""
_FRAME: Final = "frame.parquet"
_KEYS: Final = (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP, schema.SESSION_ID)
_OPTIONS: Final = (
    (r" or --max-session \d+", ""),
    (r"--column (\w+)=('[^']*'|\.\.\.)", r"mapping=LogMapping({'\1': \2})"),
    (r"--column (\w+)=", r"mapping=LogMapping({'\1': ''})"),
    (r"--where (\"[^\"]*\")", r"mapping=LogMapping(where=\1)"),
    (r"--time-format ('[^']*')", r"mapping=LogMapping(time_format=\1)"),
    (r"--earliest ([\d-]+)", r"mapping=LogMapping(earliest='\1')"),
    (r"--time-format", "LogMapping.time_format"),
    (r"--(where|earliest|partitions|column)", r"LogMapping.\1"),
    (r"--liked", "liked"),
    (r"--k\b", "k"),
    (r" with --out", ""),
    (r"--policy ([\w-]+)", r"policy='\1'"),
)
"""Options of commands in messages, and what they are in Python."""
_NOT_THE_USERS: Final = re.compile(r"(ucfrec|contextlib)(\.|$)")
"""Modules whose lines a warning does not name."""


def require_logs(name: str, value: object) -> object:
    """Check that a value is a frame, files or a store.

    Raises:
        InputError: it is something else.
    """
    if not (_are_paths(value) or isinstance(value, (pd.DataFrame, LogFiles, EpisodeStore))):
        raise InputError(
            f"{name} is {shown(value)}; give a pandas DataFrame with one row per interaction, or "
            "files, folders or globs"
        )
    return value


def split_given(name: str, value: object) -> tuple[float, ...]:
    """A split as `PrepareOptions.split` has it, of shares or of times in any form.

    Raises:
        InputError: `value` is neither.
    """
    if not isinstance(value, Iterable):
        raise InputError(f"{name} is {shown(value)}; give three shares or two times")
    parts = [value] if isinstance(value, str) else list(value)
    if all(isinstance(part, Real) for part in parts):
        return tuple(float(part) for part in parts)
    return parse_split(",".join(map(str, parts)))


def _mapping(given: Columns | None) -> LogMapping:
    if given is None or isinstance(given, LogMapping):
        return given or LogMapping()
    if isinstance(given, (str, Path)):
        return read_mapping(Path(given))
    if not isinstance(given, Mapping) or not all(isinstance(each, str) for each in given.values()):
        raise InputError(
            f"mapping is {shown(given)}; give a LogMapping, a TOML file, or a dictionary of log "
            "columns to columns of the data"
        )
    return LogMapping(given)


def store_given(
    data: EpisodeStore | Logs, mapping: Columns | None, scratch: Path, options: Mapping[str, Any]
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
    given, dataset = _mapping(mapping), options.get("dataset", "generic")
    if "dataset" in options and not _are_paths(data):
        raise InputError(f"dataset is {dataset!r}, but only files have one; leave it out")
    if isinstance(data, LogFiles):
        files, given, dataset = data.files, given.over(data.mapping), data.dataset
    elif _are_paths(data):
        adapter: Dataset = load_plugin("datasets", dataset)
        files, given = adapter.resolve(_paths(data), given)
    else:
        files = (_written(data, scratch),)
    with in_words_of_python(files[0] if files[0].parent == scratch else None):
        named = PrepareOptions(**{**options, "dataset": dataset})
        _require_gap(options, named.session_by or given.session_by)
        report = prepare(files, given, scratch / "store", named)
        _require_gap(options, report["session_by"])
        note_dropped("", _not_noted(report), report["rows_read"], fine=())
    (scratch / _FRAME).unlink(missing_ok=True)
    return EpisodeStore.open(scratch / "store")


def _require_gap(options: Mapping[str, Any], session_by: str | None) -> None:
    """Refuse a gap that would count for nothing; None is for what the columns decide later."""
    if "gap_minutes" in options and session_by not in (None, "gap"):
        raise InputError(
            f"gap_minutes is {options['gap_minutes']:g}, but sessions are those of "
            f"session_by={session_by!r}; leave it out, or give session_by='gap'"
        )


def _not_noted(report: Mapping[str, Any]) -> dict[str, int]:
    """Rows that a report counts as dropped, by reason, without the reasons that `prepare` notes."""
    dropped: Mapping[str, int] = report["dropped"]
    wanted = report["rows_read"] - dropped["left_out"]
    return {
        reason: n for reason, n in dropped.items() if n <= MANY * wanted or reason == "left_out"
    }


@contextmanager
def logs_given(
    trained: TrainedPolicy, logs: Logs | None, mapping: Columns | None, keep_unknown: bool
) -> Iterator[LoggedSessions]:
    """Later logs of a policy, or None for the test split of its store.

    Args:
        trained: the policy.
        logs: the logs.
        mapping: of their columns; what it leaves open is as in the training log.
        keep_unknown: see `read_logged_sessions`.

    Raises:
        InputError: the logs cannot be used.
    """
    if logs is None:
        if mapping is not None:
            raise InputError("mapping is of logs, and none are given; leave it out")
        yield held_out_sessions([trained])
        return
    with ExitStack() as stack:
        files, given, frame = stack.enter_context(files_given(trained, logs, mapping))
        with in_words_of_python(frame):
            read = read_logged_sessions(trained, files, given, keep_unknown)
            logged = stack.enter_context(read)
            note_dropped("", _not_noted(logged.report), logged.report["rows_read"])
        with _errors_in_words_of_python(frame):
            yield logged


@contextmanager
def files_given(
    trained: TrainedPolicy, logs: Logs, mapping: Columns | None
) -> Iterator[tuple[tuple[Path, ...], LogMapping, Path | None]]:
    """Later logs of a policy as files: the files, the mapping, and the file of a frame, which lasts
    as long as the block; None for files.

    Raises:
        InputError: a path is missing, or the frame cannot be used.
    """
    given = _mapping(mapping)
    if isinstance(logs, LogFiles):
        yield logs.files, given.over(logs.mapping), None
    elif _are_paths(logs):
        yield *later_logs(trained, _paths(logs), given), None
    else:
        with scratch_folder(Path(gettempdir()), "frame") as scratch:
            file = _written(logs, scratch)
            yield (file,), given, file


def histories_given(
    trained: TrainedPolicy,
    frame: pd.DataFrame | None,
    mapping: Columns | None,
    users: Iterable[Any] | None,
) -> Iterator[Histories]:
    """Histories of users: of a frame, or None for what the store of the run has of them.

    Raises:
        InputError: the frame cannot be used, the store is gone, `users` is no list of ids, or one
            of them has no rows.
    """
    stored = frame is None
    wanted = None if users is None else require_ids("users", users, schema.USER_ID)
    if frame is None:
        frame = _stored(trained, wanted)
        mapping = LogMapping({name: name for name in _KEYS if name in frame})
    histories = histories_of_frame(trained, frame, _mapping(mapping), stored)
    return histories if wanted is None else select_users(histories, wanted)


def _stored(trained: TrainedPolicy, users: Array | None) -> pd.DataFrame:
    """The rows of the run's store, of some users or all."""
    store = trained.require_store("give the histories of the users as a frame")
    if users is not None:
        numbers = trained.users.numbers(users)
        kept = pd.Series(store.episode_values(schema.USER)).isin(numbers[numbers >= 0])
        if not kept.any():
            raise InputError(f"none of the {len(users):,} users is in the store of the run")
        store = store.select(kept.to_numpy().nonzero()[0])
    names = (schema.PROPENSITY, schema.IS_RANDOM, schema.SPLIT)
    return store.to_frame().drop(columns=list(names), errors="ignore")


def _written(frame: Any, scratch: Path) -> Path:
    """A frame as a file that is read like any log."""
    file = scratch / _FRAME
    pq.write_table(log_table(frame, "data"), file)
    return file


def _are_paths(logs: object) -> bool:
    several = isinstance(logs, Sequence) and all(isinstance(one, (str, Path)) for one in logs)
    return isinstance(logs, (str, Path)) or several


def _paths(logs: Any) -> list[str | Path]:
    return [logs] if isinstance(logs, (str, Path)) else list(logs)


@contextmanager
def in_words_of_python(file: Path | None = None) -> Iterator[None]:
    """Let errors and warnings of the block name arguments, not a scratch file or options.

    Args:
        file: scratch file of the argument `data`.
    """

    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        with _errors_in_words_of_python(file):
            yield
    for each in noted:
        warnings.warn(each.category(_translated(each.message, file)), stacklevel=_level_of_caller())


@contextmanager
def _errors_in_words_of_python(file: Path | None) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        raise InputError(_translated(error, file)) from None


def _translated(message: object, file: Path | None) -> str:
    text = str(message) if file is None else str(message).replace(str(file), "data")
    for option, python in _OPTIONS:
        text = re.sub(option, python, text)
    return text


def _level_of_caller() -> int:
    """The `stacklevel` at which a warning of the calling function names the user's line."""
    level, frame = 0, sys._getframe()
    while frame.f_back is not None and _NOT_THE_USERS.match(frame.f_globals.get("__name__", "")):
        level, frame = level + 1, frame.f_back
    return level
