"""Add new logs to an episode store: a new store that shares the old shards and has further ones.

Nothing of the old logs is read again. Users and items of the store keep their numbers, new ones
follow. All old rows become training rows, and the newest of the new rows validate and test.
"""

import hashlib
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.episodes.record import Source, StoreRecord
from ucfrec.errors import InputError, warn_user
from ucfrec.files.atomic import atomic_folder
from ucfrec.files.record import file_checksum
from ucfrec.logs.candidates import list_set_files
from ucfrec.logs.expressions import Expression
from ucfrec.logs.features import encode_ids, note_lacking
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.prepare import PreparedLog, PrepareOptions, feature_tables, read_log
from ucfrec.logs.rows import FAULTY
from ucfrec.logs.sessions import ID_TABLES, write_ids, write_steps
from ucfrec.logs.summary import note_unknown
from ucfrec.logs.typed import TypedLog
from ucfrec.processes import progress

SPLIT = (0.6, 0.2, 0.2)
"""Shares of the new rows, in order of time, that train, validate and test."""
_FILL = {
    schema.PROPENSITY: np.nan,
    **dict.fromkeys((schema.SESSION_BEGAN, schema.CANDIDATES), -1),
    **dict.fromkeys((schema.IS_RANDOM, schema.PLACE, schema.EXCLUDES_SEEN), 0),
}
"""Step columns that some logs of a store may lack, and what their steps have instead."""
_DENSER = 20
_LATEST = 210_000
"""Number of the latest rows of a log among which its end is looked for."""


@dataclass(frozen=True)
class AppendOptions:
    """How `append_logs` adds logs."""

    window_ms: int | None = None
    """Leave out sessions that ended longer than this before the new logs end; None keeps all."""
    split: tuple[float, ...] = SPLIT
    """As of `PrepareOptions`, of the new rows."""
    memory_limit: str = "2GB"
    """As of `PrepareOptions`."""


def append_logs(
    store: Path,
    paths: Sequence[str | Path],
    out: Path,
    mapping: LogMapping | None = None,
    options: AppendOptions | None = None,
) -> dict[str, Any]:
    """Write a store of the old episodes and of those of new logs, atomically.

    Logs that are given twice count once: rows that are not after the end of the store (`find_end`)
    are left out as `clock_out_of_range`, later ones whose user, item and time a row of the store
    has as duplicates. A session that goes on in the new logs is two episodes.

    Args:
        store: folder of a store of items that `prepare` or this function wrote.
        out: new folder; a store that the same call wrote there earlier is left as it is.
        mapping: log columns to the files' columns; what it leaves open is as in the logs of the
            store. Its feature tables give vectors and tags to new items.

    Returns the counts of `prepare` on the new logs, with `new_users` and `new_items` (numbers of
    ids), `new_user_steps` and `new_item_steps` (steps that have them), and `expired_steps`. Raises
    InputError if the logs cannot be used or leave nothing to test on, or `out` is another store.
    """
    options, mapping = options or AppendOptions(), mapping or LogMapping()
    files, old = log_files(paths), StoreRecord.read(store)
    if schema.ITEM not in old.columns or old.source.time_range_ms is None:
        raise InputError(f"{store}: logs can be added only to a store of logs of items")
    made_of = _describe_inputs(old, files, mapping, options)
    if (out / StoreRecord.FILE).is_file():
        remembered = StoreRecord.read(out).source.others
        if "made_of" not in remembered:
            raise InputError(f"{out} is a store that no update made; name another folder")
        if faults := [key for key in made_of if remembered["made_of"].get(key) != made_of[key]]:
            raise InputError(
                f"{out} is a store of {' and of '.join(faults)}; give the same as before, or name "
                "another folder"
            )
        return dict(remembered["appended"])
    old.require(store, *old.files)
    origin = str(store / StoreRecord.FILE)
    shards = [_Shard(store / f"shard-{number:05d}") for number in range(old.n_shards)]
    every = (shard.times for shard in shards)
    latest = [np.partition(times, -min(_LATEST, len(times)))[-_LATEST:] for times in every]
    end = find_end(np.concatenate(latest))
    mapping = replace(
        mapping.over(LogMapping.of_source(old.source, origin)),
        earliest=datetime.fromtimestamp((end + 1) / 1000, UTC).isoformat(),
    )
    if schema.OBSERVATION not in old.columns:
        mapping = LogMapping({schema.OBSERVATION: ""}).over(mapping)
    reading = PrepareOptions(
        Expression(old.reward, origin),
        old.source.session_by,
        min_steps=old.source.min_steps,
        max_session=old.source.max_session,
        split=options.split,
        duplicates=old.source.duplicates,
        memory_limit=options.memory_limit,
        gap_minutes=(old.source.session_gap_ms or 1_800_000) / 60_000,
    )
    is_later = any((shard.times > end).any() for shard in shards)
    late = _rows_after(end, store, shards) if is_later else None
    with (
        atomic_folder(out) as folder,
        read_log(files, mapping, reading, out.parent, store, grows=True, held=late) as log,
    ):
        _require_held_out(log.rows.log.name, log.report)
        if late is not None:
            _note_late(log.rows.log, store, late, end)
        if options.window_ms is not None:
            _expire(shards, log.rows.log, options.window_ms)
        counts = _survey_ids(log, mapping, store, old)
        return _write(store, old, shards, log, folder, counts, made_of)


def find_end(times: IntArray) -> int:
    """When a log ends, of its latest times in any order: the last one, or one before it if the
    clocks of a few rows were fast.

    The last rows are such if the rows before them, up to `_DENSER` times as many, are more than
    `_DENSER` times as dense, as a row every 30 seconds before one that is 10 minutes later.
    """
    latest, last = np.sort(times)[::-1], len(times) - 1
    late = np.arange(1, max(len(times) // (_DENSER + 1), 1) + 1)
    ends, begins = (np.minimum(late * factor, last) for factor in (1, _DENSER + 1))
    pauses, spans = latest[0] - latest[ends], latest[ends] - latest[begins]
    densities = (pauses / late) * (begins - ends) / np.maximum(spans, 1)
    best = int(densities.argmax())
    return int(latest[ends[best]] if densities[best] > _DENSER else latest[0])


def _rows_after(end: int, store: Path, shards: Sequence["_Shard"]) -> pa.Table:
    """User and item, as text, and time of the rows of a store after its end."""

    def join(name: str) -> Array:
        return np.concatenate([shard.load(name, shard.times > end) for shard in shards])

    columns: dict[str, Any] = {schema.TIMESTAMP: join(schema.TIMESTAMP)}
    for (name, _, file), column in zip(ID_TABLES, (schema.USER, schema.ITEM), strict=True):
        numbers, ids = join(column), pq.read_table(store / file, columns=[name])[name]
        columns[name] = ids.take(pa.array(numbers, mask=numbers < 0)).cast(pa.string())
    return pa.table(columns)


def _note_late(
    log: TypedLog,
    store: Path,
    late: pa.Table,
    end: int,
) -> None:
    """Warn of rows of a store after its end, if new rows come before some of them."""
    last = late[schema.TIMESTAMP].to_numpy().max()
    (count,) = log.one(
        f"SELECT count(*) FROM {FAULTY} WHERE fault = 0 AND {schema.TIMESTAMP} < {last}"
    )
    if count:
        warn_user(
            f"{store}: {_describe_late(late, end)}; {count:,} new rows between are added. Correct "
            "the clocks, prepare all logs again and train"
        )


def _expire(shards: Sequence["_Shard"], log: TypedLog, window_ms: int) -> None:
    """Leave out the sessions that ended longer before the end of the new log."""
    columns = ", ".join((schema.TIMESTAMP, *(name for name, _, _ in ID_TABLES)))
    latest = log.connection.sql(
        f"SELECT {columns} FROM {FAULTY} WHERE fault = 0 ORDER BY {schema.TIMESTAMP} DESC "
        f"LIMIT {_LATEST}"
    ).to_arrow_table()
    times = latest[schema.TIMESTAMP].to_numpy()
    end = find_end(times)
    if end < times[0]:
        late = latest.filter(times > end)
        warn_user(f"{log.name}: {_describe_late(late, end)}; the window ends there, too")
    for shard in shards:
        shard.stays = shard.times[shard.offsets[1:] - 1] >= end - window_ms


def _describe_late(late: pa.Table, end: int) -> str:
    latest = late.sort_by([(schema.TIMESTAMP, "descending")]).slice(0, 3).to_pylist()
    return (
        f"{late.num_rows:,} row(s) are after {datetime.fromtimestamp(end / 1000, UTC)}, where the "
        f"log seems to end, as if clocks were fast (the latest: {latest})"
    )


def _describe_inputs(
    old: StoreRecord,
    files: Sequence[Path],
    mapping: LogMapping,
    options: AppendOptions,
) -> dict[str, Any]:
    """What the grown store depends on, to know it again; the keys name it where it differs."""
    tables = (*mapping.item_features, *mapping.user_features)
    feature_files = (file for table in tables for file in log_files(table.files))
    set_files = list_set_files(mapping, files)
    return {
        "another run's store": old.fingerprint,
        "other logs": [file_checksum(file) for file in (*files, *set_files)],
        "other columns or conditions in the mapping": mapping.remember(),
        "other feature tables in the mapping": [file_checksum(file) for file in feature_files],
        "another window": options.window_ms,
        "another split": list(options.split),
    }


def _require_held_out(name: str, report: Mapping[str, Any]) -> None:
    """Check that there are rows to choose a rule and to compare on."""
    for split in ("validation", "test"):
        if not report["splits"][split]["episodes"]:
            rows = f"{report['steps']:,}, in {report['sessions']:,} session(s)"
            raise InputError(
                f"{name}: the new rows ({rows}) leave no {split} rows, to choose a rule and "
                "compare the runs on; give more rows, or another --split"
            )


def _survey_ids(
    log: PreparedLog,
    mapping: LogMapping,
    store: Path,
    old: StoreRecord,
) -> dict[str, int]:
    """How many ids are new, and the steps that have them, with warnings of unusual ones."""
    typed, counts = log.rows.log, {}
    for name, table, file in ID_TABLES:
        old_count = pq.read_metadata(store / file).num_rows
        is_new = f"number >= {old_count}"
        used_ids = f"used_{table} JOIN {table} USING ({name})"
        ids, new, steps = typed.one(
            f"SELECT count(*), count(*) FILTER ({is_new}), "
            f"CAST(coalesce(sum(steps) FILTER ({is_new}), 0) AS BIGINT) FROM {used_ids}"
        )
        # New ids are usual here; only logs without any old one may be written in another way.
        if new == ids:
            note_unknown(typed.name, name, new, ids, f"of {store}")
        tables, whose = feature_tables(mapping)[name], name.removesuffix("_id")
        rows = f"(SELECT {name} FROM {used_ids} WHERE {is_new})"
        note_lacking(typed.connection, tables, log.features[name], name, rows, f"new {whose}s")
        if new and not tables and name in old.source.features:
            warn_user(
                f"{store} was prepared with {whose} features and none are given now: all {new:,} "
                f"new {whose}s begin at the mean; give a current table with --mapping"
            )
        counts[f"new_{table}"] = typed.one(f"SELECT count(*) FROM {table}")[0] - old_count
        counts[f"new_{table.removesuffix('s')}_steps"] = steps
    return counts


class _Shard:
    """A shard of the old store: `lengths` of episodes, whether each `stays` (E,); `times` (S,)."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.offsets = folder, np.load(folder / f"{schema.OFFSETS}.npy")
        self.lengths = np.diff(self.offsets)
        self.times: IntArray = np.load(folder / f"{schema.TIMESTAMP}.npy", mmap_mode="r")
        self.stays: BoolArray = np.ones(len(self.lengths), dtype=bool)

    def load(self, name: str, rows: BoolArray) -> Array:
        """A column of steps or episodes, at the steps of episodes (E,) or at steps (S,)."""
        values = np.load(self.folder / f"{name}.npy", mmap_mode="r")
        if len(rows) == len(self.lengths):
            rows = np.repeat(rows, self.lengths)
        if name in schema.EPISODE_DTYPES:
            values = np.repeat(values, self.lengths)
        return np.asarray(values[rows])


def _write(
    store: Path,
    old: StoreRecord,
    shards: Sequence[_Shard],
    log: PreparedLog,
    folder: Path,
    counts: Mapping[str, int],
    made_of: Mapping[str, Any],
) -> dict[str, Any]:
    """Write the store to a scratch folder; returns the report."""
    from ucfrec.logs.items import write_grown_states  # imports scipy and torch

    typed = log.rows.log
    left = [shard for shard in shards if shard.stays.any()]
    present = {*typed.columns} - ({schema.CANDIDATES} if log.sets is None else set())
    present |= {schema.PLACE} if log.rows.has_lists else set()
    added = [name for name in _FILL if name in present and name not in old.columns]
    if schema.OBSERVATION in old.columns and schema.OBSERVATION not in typed.columns:
        raise InputError(
            f"{typed.name} has no observation, {store} has; name its column with --column"
        )
    _move_train_counts(typed, shards)
    fill = {name: float(_FILL.get(name, np.nan)) for name in (*old.columns, *added)}
    with progress(log.report["steps"], "write the new shards", "steps") as bar:
        writer = write_steps(log.rows, log.cut, folder, bar, log.offers, log.sets, len(left), fill)
    ids = write_ids(typed, folder, log.offers)
    new = writer.finish(log.report["reward"], log.report, ids)
    expired = sum(int(shard.lengths[~shard.stays].sum()) for shard in shards)
    report = {**log.report, **counts, "expired_steps": expired}
    files = dict(new.files)
    for number, shard in enumerate(left):
        files |= _copy_shard(shard, folder / f"shard-{number:05d}", old, added)
    shards_added = range(len(left), new.n_shards)
    write_grown_states(store, folder, shards_added, encode_ids(typed.connection, log.features))
    origin = {"made_of": dict(made_of), "appended": report}
    _merge_records(old, new, left, report, origin).copy_with(files=files).seal(folder)
    return report


def _move_train_counts(log: TypedLog, shards: Sequence[_Shard]) -> None:
    """Update `train_count`: old validation and test rows train now, expired rows no longer."""
    for (_, table, _), column in zip(ID_TABLES, (schema.USER, schema.ITEM), strict=True):
        (size,) = log.one(f"SELECT count(*) FROM {table}")
        moved = np.zeros(size, dtype=np.int64)
        for shard in shards:
            held_out = np.load(shard.folder / f"{schema.SPLIT}.npy") > 0
            for episodes, sign in ((held_out & shard.stays, 1), (~held_out & ~shard.stays, -1)):
                numbers = shard.load(column, episodes)
                moved += sign * np.bincount(numbers[numbers >= 0], minlength=size)
        changed = np.flatnonzero(moved)
        rows = pa.table({"number": changed, "moved": moved[changed]})
        log.connection.register("moved_rows", rows)
        log.connection.execute(
            f"UPDATE {table} SET train_count = train_count + moved FROM moved_rows m "
            f"WHERE {table}.number = m.number"
        )
        log.connection.unregister("moved_rows")


def _copy_shard(
    shard: _Shard,
    target: Path,
    old: StoreRecord,
    added: Sequence[str],
) -> dict[str, tuple[int, str]]:
    """Link or write the files of an old shard, and columns `added`; returns known checksums."""
    target.mkdir()
    checksums, whole = {}, bool(shard.stays.all())
    for file in sorted(shard.folder.glob("*.npy")):
        name = file.stem
        if name == schema.SPLIT:
            np.save(target / file.name, np.zeros(int(shard.stays.sum()), dtype=np.uint8))
        elif whole:
            try:
                os.link(file, target / file.name)
            except OSError:  # another file system, or one without links
                shutil.copyfile(file, target / file.name)
            entry = old.files.get(f"{shard.folder.name}/{file.name}")
            if entry is not None:
                checksums[f"{target.name}/{file.name}"] = entry
        elif name == schema.OFFSETS:
            np.save(target / file.name, np.append(0, np.cumsum(shard.lengths[shard.stays])))
        elif name in schema.EPISODE_DTYPES:
            np.save(target / file.name, np.load(file, mmap_mode="r")[shard.stays])
        else:
            np.save(target / file.name, shard.load(name, shard.stays))
    count = int(shard.lengths[shard.stays].sum())
    for name in added:
        np.save(target / f"{name}.npy", np.full(count, _FILL[name], schema.STEP_DTYPES[name]))
    return checksums


def _merge_records(
    old: StoreRecord,
    new: StoreRecord,
    left: Sequence[_Shard],
    report: Mapping[str, Any],
    origin: Mapping[str, Any],
) -> StoreRecord:
    """The record of the new steps, with those of the old ones that are left."""
    lengths = [shard.lengths[shard.stays] for shard in left]
    episodes, steps = sum(map(len, lengths)), sum(int(part.sum()) for part in lengths)
    dropped = Counter(old.source.dropped)
    dropped.update(report["dropped"])
    times = [*report["time_range_ms"]]
    for shard in left:
        of_shard = shard.load(schema.TIMESTAMP, shard.stays)
        times += [int(of_shard.min()), int(of_shard.max())]
    source = {
        **old.source.model_dump(),
        "files": [*old.source.files, *map(str, report["files"])],
        "rows_read": (old.source.rows_read or 0) + report["rows_read"],
        "dropped": dropped,
        "steps": steps + new.n_steps,
        "decisions": None,
        "time_range_ms": [min(times), max(times)],
        "split_times_ms": report["split_times_ms"],
        **origin,
    }
    splits = {name: dict(counts) for name, counts in new.splits.items()}
    splits["train"]["episodes"] += episodes
    splits["train"]["steps"] += steps
    chain = f"{old.fingerprint};{report['expired_steps']};{new.fingerprint}"
    return new.copy_with(
        n_steps=steps + new.n_steps,
        n_episodes=episodes + new.n_episodes,
        fingerprint=hashlib.sha256(chain.encode()).hexdigest(),
        splits=splits,
        source=Source.model_validate(source),
    )
