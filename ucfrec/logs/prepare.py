"""Turn Parquet and CSV logs into an episode store: clean rows, form sessions, write episodes.

An embedded DuckDB reads and sorts the rows once, out of core (`sorted_rows`). What follows are
passes over the sorted rows in batches: sessions and splits (`sessions`), counts (`measures`) and
the steps of the store (`ids`).
"""

import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final

from ucfrec import schema
from ucfrec.episodes.item_table import ITEM_STATES
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder
from ucfrec.files.locks import scratch_folder
from ucfrec.logs.binding import explained, settled
from ucfrec.logs.engine import engine
from ucfrec.logs.feature_tables import (
    feature_digest,
    load_features,
    note_unread_features,
    require_known_ids,
)
from ucfrec.logs.ids import (
    EPISODE_USERS,
    ID_TABLES,
    ITEMS_FILE,
    USERS_FILE,
    number_ids,
    text_ids,
    write_episode_users,
    write_ids,
    write_steps,
)
from ucfrec.logs.kept import DUPLICATES, require_rows
from ucfrec.logs.mapping import SESSIONS, FeatureTable, LogMapping, log_files
from ucfrec.logs.measures import count_steps
from ucfrec.logs.sessions import Cut, split_bounds
from ucfrec.logs.sorted_rows import SortedRows, sort_rows
from ucfrec.logs.summary import (
    build_report,
    note_bots,
    note_empty_splits,
    note_equal_times,
    note_losses,
    note_one_item,
    require_variety,
)
from ucfrec.logs.tables import open_tables
from ucfrec.logs.typed import TypedLog, typed_log
from ucfrec.progress import progress

ENGINES: Final = ("duckdb", "spark")


@dataclass(frozen=True)
class PrepareOptions:
    """How `prepare` turns logs into episodes.

    Raises:
        InputError: a value is out of range.
    """

    reward: str | None = None
    """Scalar SQL expression over the files' columns; None for that of the mapping, else the column
    `reward`. If a part of it is undefined (missing, NaN, infinite, division by zero), the reward is
    undefined, even inside `least` and `greatest`; `coalesce` gives a default."""
    session_by: str | None = None
    """"session_id", "gap" or "user" (one session per user); None for that of the mapping, else
    session_id if the log has it, else gap."""
    gap_minutes: float = 30.0
    """With "gap": a longer pause of the user ends the session, in minutes."""
    min_steps: int = 1
    """Episodes with fewer steps are dropped."""
    max_session: int | None = None
    """Episodes with more steps are dropped, as of bots; None for none."""
    split: tuple[float, ...] = (0.8, 0.1, 0.1)
    """Shares of the rows for train, validation and test in order of time, or the two times (ms) at
    which validation and test begin."""
    embedding_size: int = 32
    """Most dimensions of an item embedding."""
    duplicates: str = "highest"
    """Key of `ucfrec.logs.kept.DUPLICATES`: which of several rows with the same user, item or
    action, and time is kept; with "first" and "last" the order of files and rows matters."""
    memory_limit: str = "2GB"
    """Memory of the process, e.g. "2GB", for logs of any size; rows spill to disk. From "800MB" on
    it holds, below that half of it is the engine's."""
    temp_folder: Path | None = None
    """Folder for spilled rows; None for the parent of the store (the system's for `validate`)."""

    dataset: str | None = None
    """Name of the dataset adapter, for the record."""
    engine: str = "duckdb"
    """What reads and sorts the rows, one of `ENGINES`: DuckDB on this machine, or Spark. The store
    is the same."""
    spark_master: str = "local[*]"
    """With "spark": its master. Logs and the scratch folder must lie where the driver and every
    worker see them; the memory of Spark is set in its own configuration."""

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise InputError(f"engine is {self.engine!r}; use {', '.join(ENGINES)}")
        if self.session_by not in (None, *SESSIONS):
            raise InputError(f"session_by is {self.session_by!r}; use {', '.join(SESSIONS)}")
        if self.duplicates not in DUPLICATES:
            raise InputError(f"duplicates is {self.duplicates!r}; use {', '.join(DUPLICATES)}")
        if not (self.gap_minutes > 0 and self.min_steps >= 1 and self.embedding_size >= 1):
            raise InputError("gap_minutes, min_steps and embedding_size must be above 0")
        if self.max_session is not None and self.max_session < self.min_steps:
            raise InputError("max_session is below min_steps, so no session would be left")
        if self.gap_minutes == math.inf:
            raise InputError("gap_minutes is infinite; use session_by='user' for sessions of users")
        finite = all(math.isfinite(bound) for bound in self.split)
        times = finite and len(self.split) == 2 and self.split[0] <= self.split[1]
        shares = len(self.split) == 3 and min(self.split) >= 0 and self.split[0] > 0
        if not times and not (shares and abs(sum(self.split) - 1) < 1e-9):
            raise InputError(
                f"split is {self.split}: give three shares that add up to 1, the first above 0, or "
                "two times in order"
            )


def parse_split(text: str) -> tuple[float, ...]:
    """Read a split: "0.8,0.1,0.1", or two times "2022-04-28,2022-04-29T12:00" (UTC by default).

    Returns:
        Three shares, or two times in ms, as in `PrepareOptions.split`.

    Raises:
        InputError: `text` is neither.
    """
    parts = text.split(",")
    try:
        if len(parts) == 3:
            return tuple(float(part) for part in parts)
        times = [datetime.fromisoformat(part.strip()) for part in parts]
    except ValueError:
        times = []
    if len(times) != 2:
        raise InputError(f"split {text!r}: write shares as 0.8,0.1,0.1 or two times in ISO format")
    return tuple(t.replace(tzinfo=t.tzinfo or UTC).timestamp() * 1000 for t in times)


def prepare(
    paths: Sequence[str | Path],
    mapping: LogMapping,
    out: str | Path,
    options: PrepareOptions | None = None,
    like: Path | None = None,
    keep_unknown: bool = False,
) -> dict[str, Any]:
    """Write the logs as an `EpisodeStore` at `out`, atomically.

    Users and items are those of the log and of the feature tables, in sorted order: rows of
    `users.parquet` (user_id) and `items.parquet` (item_id), each with its train_count. A session
    that spans a split boundary is cut there: each piece is an episode, and only the last one is
    terminated. The same rows give the same fingerprint in any order.

    Args:
        paths: log files, folders and globs.
        mapping: log columns to the files' columns.
        out: new folder for the store.
        options: None for the defaults.
        like: a store, or a run trained on it, whose users, items and item states are reused, to
            evaluate the policy on other logs. Rows with other items are dropped, other users have
            number −1 (`episode_users.parquet` has the user of every episode), and every session is
            one episode of the split "train".
        keep_unknown: with `like`, keep rows with other items, as item −1.

    Returns:
        Counts of what was read, dropped and written, for `format_report`; also in the store's
        `meta.json` under "source".

    Raises:
        InputError: the input cannot be used, `out` exists, or the disk is full.
    """
    options, out = options or PrepareOptions(), Path(out)
    if hasattr(paths, "columns"):
        raise InputError(
            "paths is a frame; give log files, folders or globs here, and frames to Recommender.fit"
        )
    files = log_files(paths)
    if like is not None and not (like / USERS_FILE).is_file():
        raise InputError(f"{like} is neither an episode store nor a run: it has no {USERS_FILE}")
    with atomic_folder(out) as folder:
        spill = options.temp_folder or out.parent
        with (
            prepared_log(files, mapping, options, spill, like, keep_unknown) as prepared,
            explained(prepared.rows.log.connection, prepared.rows.log.tables, out.parent),
        ):
            log, report = prepared.rows.log, prepared.report
            with progress(report["steps"], "write the store", "steps") as bar:
                writer = write_steps(prepared.rows, prepared.cut, folder, bar)
            ids = {**write_ids(log, folder), **_feature_digests(prepared)}
            record = writer.finish(report["reward"], report, ids)
            if log.key == schema.ITEM_ID:
                _write_states(prepared, folder, options.embedding_size, like)
            if like is not None:
                write_episode_users(log, folder / EPISODE_USERS)
            record.seal(folder)
    return report


def validate(
    paths: Sequence[str | Path], mapping: LogMapping, options: PrepareOptions | None = None
) -> dict[str, Any]:
    """Check the logs as `prepare` does, without writing a store.

    Args:
        paths: log files, folders and globs.
        mapping: log columns to the files' columns.
        options: None for the defaults.

    Returns:
        The report that `prepare` would return.

    Raises:
        InputError: the input cannot be used.
    """
    options = options or PrepareOptions()
    spill = options.temp_folder or Path(gettempdir())
    with prepared_log(log_files(paths), mapping, options, spill, None) as prepared:
        return prepared.report


Features = dict[str, list[str]]
"""Id column to the names of its DuckDB feature tables."""


@dataclass(frozen=True)
class PreparedLog:
    """A log that is sorted and counted."""

    rows: SortedRows
    cut: Cut
    features: Features
    report: dict[str, Any]
    scratch: Path
    """Folder for scratch."""


@contextmanager
def prepared_log(
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    spill: Path,
    like: Path | None,
    keep_unknown: bool = False,
    onto: Path | None = None,
) -> Iterator[PreparedLog]:
    """The log, sorted and counted, with the tables of its ids; `onto` is a store whose users and
    items keep their numbers, and others follow."""
    reward = options.reward or mapping.reward or schema.REWARD
    session_by = options.session_by or mapping.session_by
    known_items = None if like is None or keep_unknown else like / ITEMS_FILE
    inputs = (*files, *_other_inputs(mapping, like, onto))
    with (
        scratch_folder(spill, "sorted") as scratch,
        engine(inputs, spill, options.memory_limit, shared=True) as connection,
    ):
        with progress(4, "check the logs", "stages") as stage:
            tables = tuple(open_tables(connection, files, mapping.partitions))
            mapping, reward = settled(connection, tables, mapping, reward)
            typed = connection, tables, mapping, reward, session_by
            if options.engine == "spark":
                from ucfrec.logs.spark import sort_with_spark  # an extra

                rows = sort_with_spark(
                    *typed, known_items, scratch, options.duplicates, options.spark_master
                )
            else:
                log = typed_log(*typed, spill, text_ids(onto or like))
                with explained(connection, log.tables, spill):
                    by_session = log.session_by == schema.SESSION_ID
                    rows = sort_rows(log, known_items, options.duplicates, scratch, by_session)
            log = rows.log
            with explained(connection, log.tables, spill):
                require_rows(log, rows.count, rows.dropped, onto)
                note_losses(rows, reward, mapping.where)
                if like is None and onto is None:
                    require_variety(rows)
                    note_unread_features(files, mapping)
                note_equal_times(rows, mapping.columns.get(schema.TIMESTAMP, schema.TIMESTAMP))
                stage.update()
                cut = _cut(rows, options, like)
                counts = count_steps(rows, cut)
                stage.update()
                features = _features(log, mapping, like)
                number_ids(log, features, like, onto)
                report = {"reward": reward, **build_report(rows, cut, counts)}
                if like is None and onto is None:
                    note_one_item(rows, report)
                    if len(options.split) == 2:
                        note_empty_splits(rows, report)
                note_bots(rows, report, mapping.columns.get(schema.USER_ID, schema.USER_ID))
                stage.update()
                _require_known_ids(log, mapping, features, noted=onto is None)
                report |= {"duplicates": options.duplicates}
                report |= {"dataset": options.dataset, **_remembered(mapping)}
                report |= {"min_steps": options.min_steps, "max_session": options.max_session}
                report["features"] = [name for name, names in features.items() if names]
                stage.update()
        yield PreparedLog(rows, cut, features, report, scratch)


def _cut(rows: SortedRows, options: PrepareOptions, like: Path | None) -> Cut:
    """How the rows form episodes."""
    bounds = split_bounds(rows, options.split if like is None else (1.0, 0.0, 0.0))
    gap_ms = round(options.gap_minutes * 60_000)
    return Cut(rows.log.session_by, gap_ms, options.min_steps, bounds, options.max_session)


def _remembered(mapping: LogMapping) -> dict[str, Any]:
    """What the store remembers of the mapping, for later logs."""
    memory: dict[str, Any] = {"mapping": {name: str(s) for name, s in mapping.columns.items()}}
    for name in ("time_format", "earliest", "where"):
        if (text := getattr(mapping, name)) is not None:
            memory[name] = str(text)
    return memory | ({"partitions": True} if mapping.partitions else {})


def _features(log: TypedLog, mapping: LogMapping, like: Path | None) -> Features:
    """Read the feature tables of users and items; none for a store like another."""
    if like is not None:
        return {}
    return {
        name: load_features(log.connection, tables, name, log.id_type(name))
        for name, tables in feature_tables(mapping).items()
        if name in log.columns
    }


def _feature_digests(prepared: PreparedLog) -> dict[str, list[Any]]:
    """Digests for the fingerprint of the feature tables, if there are any."""
    return {
        f"features of {name}": [feature_digest(prepared.rows.log.connection, names)]
        for name, names in prepared.features.items()
        if names
    }


def feature_tables(mapping: LogMapping) -> dict[str, tuple[FeatureTable, ...]]:
    """Id column to the feature tables of a mapping."""
    return {schema.USER_ID: mapping.user_features, schema.ITEM_ID: mapping.item_features}


def _require_known_ids(log: TypedLog, mapping: LogMapping, features: Features, noted: bool) -> None:
    """Check that feature tables are about users and items of the log; after `number_ids`."""
    id_tables = {name: f"used_{table}" for name, table, _ in ID_TABLES}
    for name, names in features.items():
        tables = feature_tables(mapping)[name]
        require_known_ids(log.connection, tables, names, name, id_tables[name], noted)


def _other_inputs(
    mapping: LogMapping, like: Path | None, onto: Path | None = None
) -> Iterator[Path]:
    """Files that are read in addition to the logs."""
    for store in (like, onto):
        if store is not None:
            yield from (store / file for _, _, file in ID_TABLES if (store / file).is_file())
    if like is not None:
        return
    for table in (*mapping.user_features, *mapping.item_features):
        yield from log_files(table.files)


def _write_states(prepared: PreparedLog, folder: Path, size: int, like: Path | None) -> None:
    """Learn the item states, or copy those of the store `like`."""
    # Only a store needs scipy, which takes a moment to import.
    from ucfrec.logs.features import encode_features, item_tags
    from ucfrec.logs.items import write_item_states

    if like is not None:
        shutil.copy(like / ITEM_STATES, folder / ITEM_STATES)
        return
    log, encoded, counts = prepared.rows.log, {}, {}
    for name, table, _ in ID_TABLES:
        (counts[name],) = log.one(f"SELECT count(*) FROM {table}")
        encoded[name] = encode_features(log.connection, prepared.features[name], table, name)
    write_item_states(
        folder,
        prepared.scratch,
        encoded[schema.ITEM_ID],
        encoded[schema.USER_ID],
        counts[schema.ITEM_ID],
        counts[schema.USER_ID],
        size,
        item_tags(log.connection, prepared.features[schema.ITEM_ID], "items", schema.ITEM_ID),
    )
