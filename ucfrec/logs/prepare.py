"""Turn Parquet and CSV logs into an episode store: clean rows, form sessions, write episodes.

An embedded DuckDB reads and sorts the rows once, out of core (`rows`). What follows are passes over
the sorted rows in batches: episodes are counted, reported on (`summary`) and written (`sessions`).
"""

import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Annotated, Any, Literal

import pyarrow as pa
from pydantic import Field, InstanceOf

from ucfrec import schema
from ucfrec.arrays import IntArray
from ucfrec.episodes.item_table import ITEM_STATES
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder, scratch_folder
from ucfrec.logs import sessions, summary
from ucfrec.logs.candidates import list_set_files
from ucfrec.logs.engine import BATCH_ROWS, engine, explain_errors
from ucfrec.logs.features import (
    count_features,
    encode_ids,
    feature_digest,
    load_features,
    read_offers,
    require_known_ids,
)
from ucfrec.logs.mapping import FeatureTable, LogMapping, log_files
from ucfrec.logs.rows import USER, SortedRows, sort_rows
from ucfrec.logs.typed import open_log, open_log_tables
from ucfrec.processes import progress
from ucfrec.settings import Count, Width, require, settings_table

if TYPE_CHECKING:
    from ucfrec.episodes.offers import Offers

_REMEMBERED = ("duplicates", "dataset", "min_steps", "max_session")
"""Options that the record of a store has."""


@settings_table("")
class PrepareOptions:
    """How `prepare` turns logs into episodes."""

    reward: InstanceOf[str] | None = None
    """Scalar SQL expression over the files' columns; None for that of the mapping, else the column
    `reward`. If a part of it is undefined (missing, NaN, infinite, division by zero), the reward is
    undefined, even inside `least` and `greatest`; `coalesce` gives a default."""
    session_by: schema.SessionBy | None = None
    """How rows form sessions ("user": one session per user); None for that of the mapping, else
    session_id if the log has it, else gap."""
    gap_minutes: Annotated[float, Field(gt=0)] = 30.0
    """With "gap": a longer pause of the user ends the session, in minutes."""
    min_steps: Count = 1
    """Episodes with fewer steps are dropped."""
    max_session: Count | None = None
    """Episodes with more steps are dropped, as of bots; None for none."""
    split: tuple[float, ...] = (0.8, 0.1, 0.1)
    """Shares of the rows for train, validation and test in order of time; the times (ms) at which
    validation and test begin; or how many last rows of every user test, and as many validate."""
    embedding_size: Width = 32
    """Most dimensions of an item embedding."""
    duplicates: Literal["highest", "lowest", "first", "last"] = "highest"
    """Which of several rows with the same user, item or action, and time is kept, by reward or by
    place; with "first" and "last" the order of files and rows matters."""
    memory_limit: str = "2GB"
    """Memory of the process, e.g. "2GB", for logs of any size; rows spill to disk. From "800MB" on
    it holds, below that half of it is the engine's."""
    temp_folder: Path | None = None
    """Folder for spilled rows; None for the parent of the store (the system's for `validate`)."""

    dataset: str | None = None
    """Name of the dataset adapter, for the record."""
    engine: Literal["duckdb", "spark"] = "duckdb"
    """What reads and sorts the rows: DuckDB on this machine, or Spark. The store is the same."""
    spark_master: str = "local[*]"
    """With "spark": its master. Logs and the scratch folder must lie where the driver and every
    worker see them; the memory of Spark is set in its own configuration."""

    def __post_init__(self) -> None:
        require(
            self.max_session is None or self.max_session >= self.min_steps,
            "max_session is below min_steps, so no session would be left",
            "max_session",
        )
        times = len(self.split) == 2 and self.split[0] <= self.split[1]
        shares = len(self.split) == 3 and min(self.split) >= 0 and self.split[0] > 0
        last = len(self.split) == 1 and self.split[0] >= 1 and float(self.split[0]).is_integer()
        require(
            last or times or (shares and math.isclose(sum(self.split), 1, abs_tol=1e-9)),
            f"split is {self.split}: give three shares that add up to 1, the first above 0, "
            "two times in order, or a number of last rows",
            "split",
        )


def parse_split(text: str) -> tuple[float, ...]:
    """Read `PrepareOptions.split`: "0.8,0.1,0.1", two times "2022-04-28,2022-04-29T12:00" (UTC by
    default), "leave-last-out" or "leave-last-5". Raises InputError if it is none of these."""
    parts, last = text.split(","), text.removeprefix("leave-last-")
    try:
        if last != text:
            return (1.0 if last == "out" else float(last),)
        if len(parts) == 3:
            return tuple(float(part) for part in parts)
        times = [datetime.fromisoformat(part.strip()) for part in parts]
    except ValueError:
        times = []
    if len(times) != 2:
        raise InputError(
            f"split {text!r}: write shares as 0.8,0.1,0.1, two times in ISO format, or "
            "leave-last-out or leave-last-5"
        )
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

    Users and items are those of the log and of the feature tables, in sorted order. A session that
    spans a split boundary is cut there: each piece is an episode, and only the last one is
    terminated. The same rows give the same fingerprint in any order.

    Args:
        paths: log files, folders and globs.
        like: a store, or a run trained on it, whose users, items and item states are reused, to
            evaluate the policy on other logs. Rows with other items are dropped, other users have
            number −1 (`episode_users.parquet` has the user of every episode), and every session is
            one episode of the split "train".
        keep_unknown: with `like`, keep rows with other items, as item −1.

    Returns counts of what was read, dropped and written, for `format_report`; they are in the
    store's `meta.json`, too, under "source". Raises InputError if the input cannot be used, `out`
    exists, or the disk is full.
    """
    options, out = options or PrepareOptions(), Path(out)
    if hasattr(paths, "columns"):
        raise InputError(
            "paths is a frame; give log files, folders or globs here, and frames to Recommender.fit"
        )
    files = log_files(paths)
    if like is not None and not (like / sessions.USERS_FILE).is_file():
        raise InputError(
            f"{like} is neither an episode store nor a run: it has no {sessions.USERS_FILE}"
        )
    with atomic_folder(out) as folder:
        spill = options.temp_folder or out.parent
        with (
            read_log(files, mapping, options, spill, like, keep_unknown=keep_unknown) as log,
            explain_errors(log.rows.log.connection, log.rows.log.tables, out.parent),
        ):
            typed, report = log.rows.log, log.report
            with progress(report["steps"], "write the store", "steps") as bar:
                writer = sessions.write_steps(log.rows, log.cut, folder, bar, log.offers, log.sets)
            ids = sessions.write_ids(typed, folder, log.offers)
            for name, tables in log.features.items():
                if tables:
                    ids[f"features of {name}"] = [feature_digest(typed.connection, tables)]
            record = writer.finish(report["reward"], report, ids)
            if like is not None and typed.key == schema.ITEM_ID:
                if (like / ITEM_STATES).is_file():
                    shutil.copy(like / ITEM_STATES, folder / ITEM_STATES)
            elif typed.key == schema.ITEM_ID:
                from ucfrec.logs.items import write_item_states  # imports scipy

                encoded = encode_ids(typed.connection, log.features)
                write_item_states(folder, log.scratch, encoded, options.embedding_size)
            if like is not None:
                source = f"{sessions.EPISODES} JOIN user_codes ON code = {USER}"
                query = f"SELECT {schema.USER_ID} FROM {source} ORDER BY episode"
                users = typed.connection.sql(query).to_arrow_reader(BATCH_ROWS)
                sessions.write_batches(folder / sessions.EPISODE_USERS, users)
            record.seal(folder)
    return report


def validate(
    paths: Sequence[str | Path], mapping: LogMapping, options: PrepareOptions | None = None
) -> dict[str, Any]:
    """Check logs as `prepare` does but write no store: returns its report, raises InputError."""
    options = options or PrepareOptions()
    spill = options.temp_folder or Path(gettempdir())
    with read_log(log_files(paths), mapping, options, spill) as log:
        return log.report


@dataclass(frozen=True)
class PreparedLog:
    """A log that is sorted and counted."""

    rows: SortedRows
    cut: sessions.Cut
    features: dict[str, list[str]]
    """Id column to the names of its DuckDB feature tables."""
    report: dict[str, Any]
    scratch: Path
    """Folder for scratch."""
    offers: "Offers | None"
    sets: IntArray | None
    """As of `read_offers`."""


@contextmanager
def read_log(
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    spill: Path,
    store: Path | None = None,
    grows: bool = False,
    keep_unknown: bool = False,
    held: pa.Table | None = None,
) -> Iterator[PreparedLog]:
    """Sort and count a log; users and items of a `store` keep their numbers.

    If it `grows`, the log is added to it, and other ids follow; if not, it is evaluated on: a
    single split, no features, and other items only with `keep_unknown`. Rows of `held` (user, item,
    time) count as duplicates.
    """
    reward = options.reward or mapping.reward or schema.REWARD
    session_by = options.session_by or mapping.session_by
    evaluates = store is not None and not grows
    known_items = store / sessions.ITEMS_FILE if store and evaluates and not keep_unknown else None
    tables_of_ids = {} if evaluates else feature_tables(mapping)
    feature_files = [
        file for tables in tables_of_ids.values() for t in tables for file in log_files(t.files)
    ]
    id_files = [store / file for _, _, file in sessions.ID_TABLES] if store else []
    inputs = (*files, *id_files, *feature_files, *list_set_files(mapping, files))
    with (
        scratch_folder(spill, "sorted") as scratch,
        engine(inputs, spill, options.memory_limit) as connection,
    ):
        with progress(4, "check the logs", "stages") as stage:
            opened = open_log_tables(connection, files, mapping, reward, session_by)
            mapping, reward = opened.mapping, opened.reward
            with explain_errors(connection, opened.tables):
                if options.engine == "spark":
                    from ucfrec.logs.spark import sort_with_spark  # an extra

                    rows = sort_with_spark(
                        opened, known_items, scratch, options.duplicates, options.spark_master
                    )
                else:
                    log = open_log(opened, sessions.list_text_ids(store))
                    by_session = log.session_by == schema.SESSION_ID
                    rows = sort_rows(
                        log, known_items, options.duplicates, scratch, by_session, held
                    )
                log = rows.log
                summary.require_rows(log, rows.count, rows.dropped, store if grows else None)
                summary.note_losses(rows, reward, mapping.where, store is None, grows)
                stage.update()
                split = (1.0, 0.0, 0.0) if evaluates else options.split
                cut = sessions.Cut(
                    log.session_by,
                    round(options.gap_minutes * 60_000),
                    options.min_steps,
                    sessions.split_bounds(rows, split),
                    options.max_session,
                    int(split[0]) if len(split) == 1 else 0,
                )
                counts = sessions.count_steps(rows, cut)
                stage.update()
                features = {
                    name: load_features(connection, tables, name, log.find_type(name))
                    for name, tables in tables_of_ids.items()
                    if name in log.columns
                }
                sessions.number_ids(log, features, store, grows)
                report = {"reward": reward, **summary.build_report(rows, cut, counts)}
                summary.note_oddities(rows, report, store is None)
                stage.update()
                offers, sets = None, None
                if log.key == schema.ITEM_ID:
                    offers, sets = read_offers(log, features.get(log.key, ()), store, grows)
                for name, names in features.items():
                    require_known_ids(connection, tables_of_ids[name], names, name, not grows)
                report |= {name: getattr(options, name) for name in _REMEMBERED}
                report |= {
                    **mapping.remember(),
                    "features": [name for name, names in features.items() if names],
                    "feature_tables": {
                        name: count_features(connection, tables_of_ids[name], names)
                        for name, names in features.items()
                    },
                }
                stage.update()
        yield PreparedLog(rows, cut, features, report, scratch, offers, sets)


def feature_tables(mapping: LogMapping) -> dict[str, tuple[FeatureTable, ...]]:
    """Id column to the feature tables of a mapping."""
    return {schema.USER_ID: mapping.user_features, schema.ITEM_ID: mapping.item_features}
