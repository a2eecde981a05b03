"""Add new logs to an episode store: a new store that shares the old shards and has further ones.

Nothing of the old logs is read again. Users and items of the store keep their numbers, new ones
follow. All old rows become training rows, and the newest of the new rows validate and test.
"""

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, IntArray
from ucfrec.episodes.record import Source, StoreRecord
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder
from ucfrec.files.record import file_checksum
from ucfrec.logs.expressions import Expression
from ucfrec.logs.feature_tables import note_lacking
from ucfrec.logs.ids import ID_TABLES, write_ids, write_steps
from ucfrec.logs.kept import note_unknown
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.prepare import PreparedLog, PrepareOptions, feature_tables, prepared_log
from ucfrec.progress import progress

SPLIT: Final = (0.6, 0.2, 0.2)
"""Shares of the new rows, in order of time, that train, validate and test."""
_FILL: Final = {schema.PROPENSITY: np.nan, schema.IS_RANDOM: 0}
"""Step columns that some logs of a store may lack, and what their steps have instead."""

_PARTS: Final = {
    "onto": "another run's store",
    "logs": "other logs",
    "mapping": "other columns or conditions in the mapping",
    "features": "other feature tables in the mapping",
    "window_ms": "another window",
    "split": "another split",
}
"""What a grown store depends on, and how a message names it where it differs."""


@dataclass(frozen=True)
class AppendOptions:
    """How `append_logs` adds logs."""

    window_ms: int | None = None
    """Sessions that ended longer ago than this, before the end of the new logs, are left out; None
    keeps all."""
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

    Old shards are hard links where the file system allows it. Rows that are not newer than the last
    row of the store are left out and counted as `clock_out_of_range`, so that logs which are given
    twice count once. A session that goes on in the new logs is two episodes.

    Args:
        store: folder of a store of items that `prepare` or this function wrote.
        paths: log files, folders and globs.
        out: new folder; a store that the same call wrote there earlier is left as it is.
        mapping: log columns to the files' columns; what it leaves open is as in the logs of the
            store. Its feature tables give vectors and tags to new items.
        options: None for the defaults.

    Returns:
        The counts of `prepare` on the new logs, with `new_users` and `new_items` (numbers of ids),
        `new_user_steps` and `new_item_steps` (steps that have them), and `expired_steps`.

    Raises:
        InputError: the logs cannot be used or leave nothing to validate or test on, or `out` is
            another store.
    """
    options, mapping = options or AppendOptions(), mapping or LogMapping()
    files, old = log_files(paths), StoreRecord.read(store)
    if schema.ITEM not in old.columns or old.source.time_range_ms is None:
        raise InputError(f"{store}: logs can be added only to a store of logs of items")
    made_of = _made_of(old, files, mapping, options)
    if (out / StoreRecord.FILE).is_file():
        return _written(out, made_of)
    last = old.source.time_range_ms[1]
    mapping = replace(
        mapping.over(LogMapping.of_source(old.source, str(store / StoreRecord.FILE))),
        earliest=datetime.fromtimestamp((last + 1) / 1000, UTC).isoformat(),
    )
    if schema.OBSERVATION not in old.columns:
        mapping = LogMapping({schema.OBSERVATION: ""}).over(mapping)
    with (
        atomic_folder(out) as folder,
        prepared_log(
            files, mapping, _prepare_options(old, store, options), out.parent, None, onto=store
        ) as prepared,
    ):
        _require_held_out(prepared.rows.log.name, prepared.report)
        _note_new_ids(prepared, store)
        _note_lacking(prepared, mapping, store, old)
        return _Grown(store, old, prepared, options.window_ms).write(folder, made_of)


def _prepare_options(old: StoreRecord, store: Path, options: AppendOptions) -> PrepareOptions:
    gap_ms = old.source.session_gap_ms
    prepared = PrepareOptions(
        Expression(old.reward, str(store / StoreRecord.FILE)),
        old.source.session_by,
        min_steps=old.source.min_steps,
        max_session=old.source.max_session,
        split=options.split,
        duplicates=old.source.duplicates,
        memory_limit=options.memory_limit,
    )
    return prepared if gap_ms is None else replace(prepared, gap_minutes=gap_ms / 60_000)


def _made_of(
    old: StoreRecord, files: Sequence[Path], mapping: LogMapping, options: AppendOptions
) -> dict[str, Any]:
    """What the grown store depends on, to know it again."""
    tables = (*mapping.item_features, *mapping.user_features)
    columns = {**mapping.columns, "where": mapping.where, "time_format": mapping.time_format}
    return {
        "onto": old.fingerprint,
        "logs": [file_checksum(file) for file in files],
        "mapping": {name: str(text) for name, text in columns.items() if text is not None},
        "features": [file_checksum(file) for table in tables for file in log_files(table.files)],
        "window_ms": options.window_ms,
        "split": list(options.split),
    }


def _require_held_out(name: str, report: Mapping[str, Any]) -> None:
    """Check, before the store is written, that there are rows to choose a rule and compare on.

    Args:
        name: of the logs, for the message.

    Raises:
        InputError: there are none.
    """
    for split in ("validation", "test"):
        if not report["splits"][split]["episodes"]:
            raise InputError(
                f"{name}: the new rows ({report['steps']:,}, in "
                f"{report['sessions']:,} session(s)) leave no {split} rows, to choose a rule and "
                "compare the runs on; give more rows, or another --split"
            )


def _note_new_ids(prepared: PreparedLog, store: Path) -> None:
    """Warn of logs that share no user, or no item, with the store."""
    log = prepared.rows.log
    for name, table, file in ID_TABLES:
        old_count = pq.read_metadata(store / file).num_rows
        ids, new = log.one(
            f"SELECT count(*), count(*) FILTER (number >= {old_count}) FROM used_{table} "
            f"JOIN {table} USING ({name})"
        )
        # New ids are usual here; only logs without any old one may be written in another way.
        if new == ids:
            note_unknown(log.name, name, new, ids, f"of {store}")


def _note_lacking(
    prepared: PreparedLog, mapping: LogMapping, store: Path, old: StoreRecord
) -> None:
    """Note the new users and items of which no feature table says anything."""
    log = prepared.rows.log
    for name, table, file in ID_TABLES:
        old_count = pq.read_metadata(store / file).num_rows
        new = (
            f"SELECT {name} FROM used_{table} JOIN {table} USING ({name}) "
            f"WHERE number >= {old_count}"
        )
        tables, views = feature_tables(mapping)[name], prepared.features[name]
        note_lacking(
            log.connection,
            tables,
            views,
            name,
            new,
            str(store) if name in old.source.features else "",
        )


def _written(out: Path, made_of: Mapping[str, Any]) -> dict[str, Any]:
    """The report on a store that is there already."""
    remembered = StoreRecord.read(out).source.others
    if "made_of" not in remembered:
        raise InputError(f"{out} is a store that no update made; name another folder")
    differences = [
        name for key, name in _PARTS.items() if remembered["made_of"].get(key) != made_of[key]
    ]
    if differences:
        raise InputError(
            f"{out} is a store of {' and of '.join(differences)}; give the same as before, or name "
            "another folder"
        )
    report = dict(remembered["appended"])
    _require_held_out(str(out), report)
    return report


@dataclass(frozen=True)
class _Shard:
    """A shard of the old store."""

    folder: Path
    lengths: IntArray
    """(E,) steps of its episodes."""
    kept: BoolArray
    """(E,) false for episodes that are left out."""

    def of_steps(self, episodes: BoolArray) -> BoolArray:
        """(N,) the value of its episode at every step."""
        return np.repeat(episodes, self.lengths)

    def load(self, name: str) -> Array:
        """A column, mapped."""
        values: Array = np.load(self.folder / f"{name}.npy", mmap_mode="r")
        return values


class _Grown:
    """A store that is grown by a log."""

    def __init__(
        self, store: Path, old: StoreRecord, prepared: PreparedLog, window_ms: int | None
    ) -> None:
        self._store, self._old, self._prepared, self._log = store, old, prepared, prepared.rows.log
        cut_ms = None if window_ms is None else prepared.report["time_range_ms"][1] - window_ms
        self._shards = [self._shard(number, cut_ms) for number in range(old.n_shards)]
        self._kept = [shard for shard in self._shards if shard.kept.any()]
        names = [*old.columns]
        names += [n for n in _FILL if n in self._log.columns and n not in names]
        if schema.OBSERVATION in names and schema.OBSERVATION not in self._log.columns:
            raise InputError(
                f"{self._log.name} has no observation, {store} has; name its column with --column"
            )
        self._names = names

    def _shard(self, number: int, cut_ms: int | None) -> _Shard:
        folder = self._store / f"shard-{number:05d}"
        offsets = np.load(folder / f"{schema.OFFSETS}.npy")
        kept = np.ones(len(offsets) - 1, dtype=bool)
        if cut_ms is not None:
            times = np.load(folder / f"{schema.TIMESTAMP}.npy", mmap_mode="r")
            kept = np.asarray(times[offsets[1:] - 1] >= cut_ms)
        return _Shard(folder, np.diff(offsets), kept)

    def write(self, folder: Path, made_of: Mapping[str, Any]) -> dict[str, Any]:
        """Write the store to a scratch folder; returns the report."""
        from ucfrec.logs.grown_states import write_grown_states  # needs torch

        prepared, log = self._prepared, self._log
        self._count_moved_rows()
        fill = {name: float(_FILL.get(name, np.nan)) for name in self._names}
        with progress(prepared.report["steps"], "write the new shards", "steps") as bar:
            writer = write_steps(prepared.rows, prepared.cut, folder, bar, len(self._kept), fill)
        new = writer.finish(prepared.report["reward"], prepared.report, write_ids(log, folder))
        report = prepared.report | self._counts(folder, new)
        files = dict(new.files)
        for number, shard in enumerate(self._kept):
            files |= self._copy(shard, folder / f"shard-{number:05d}")
        write_grown_states(self._store, folder, prepared, range(len(self._kept), new.n_shards))
        origin = {"made_of": dict(made_of), "appended": report}
        self._record(new, report, origin).copy_with(files=files).seal(folder)
        return report

    def _copy(self, shard: _Shard, target: Path) -> dict[str, tuple[int, str]]:
        """Link the files of an old shard, or write what changes; returns known checksums."""
        target.mkdir()
        checksums, whole = {}, bool(shard.kept.all())
        steps = slice(None) if whole else shard.of_steps(shard.kept)
        for file in sorted(shard.folder.glob("*.npy")):
            if file.stem == schema.SPLIT:
                np.save(target / file.name, np.zeros(int(shard.kept.sum()), dtype=np.uint8))
            elif whole:
                _link(file, target / file.name)
                entry = self._old.files.get(f"{shard.folder.name}/{file.name}")
                if entry is not None:
                    checksums[f"{target.name}/{file.name}"] = entry
            elif file.stem == schema.OFFSETS:
                np.save(target / file.name, np.append(0, np.cumsum(shard.lengths[shard.kept])))
            else:
                of_episodes = file.stem in schema.EPISODE_DTYPES
                values = shard.load(file.stem)
                np.save(target / file.name, values[shard.kept if of_episodes else steps])
        for name in set(self._names) - set(self._old.columns):
            count = int(shard.lengths[shard.kept].sum())
            np.save(target / f"{name}.npy", np.full(count, _FILL[name], schema.STEP_DTYPES[name]))
        return checksums

    def _count_moved_rows(self) -> None:
        """Update `train_count`: old validation and test rows train now, expired rows no longer."""
        for name, table, _ in ID_TABLES:
            (size,) = self._log.one(f"SELECT count(*) FROM {table}")
            moved = np.zeros(size, dtype=np.int64)
            for shard in self._shards:
                held_out = shard.load(schema.SPLIT) > 0
                for episodes, sign in ((held_out & shard.kept, 1), (~held_out & ~shard.kept, -1)):
                    if episodes.any():
                        numbers = _numbers(shard, name, episodes)
                        moved += sign * np.bincount(numbers[numbers >= 0], minlength=size)
            changed = np.flatnonzero(moved)
            rows = pa.table({"number": changed, "moved": moved[changed]})
            self._log.connection.register("moved_rows", rows)
            self._log.connection.execute(
                f"UPDATE {table} SET train_count = train_count + moved FROM moved_rows m "
                f"WHERE {table}.number = m.number"
            )
            self._log.connection.unregister("moved_rows")

    def _counts(self, folder: Path, new: StoreRecord) -> dict[str, int]:
        """How many ids and rows are new, and how many old rows are left out."""
        counts = {}
        for name, table, file in ID_TABLES:
            (total,) = self._log.one(f"SELECT count(*) FROM {table}")
            old_count = pq.read_metadata(self._store / file).num_rows
            what = table.removesuffix("s")
            counts[f"new_{table}"] = total - old_count
            steps = 0
            for number in range(len(self._kept), new.n_shards):
                shard = folder / f"shard-{number:05d}"
                offsets = np.load(shard / f"{schema.OFFSETS}.npy")
                every = np.ones(len(offsets) - 1, dtype=bool)
                of_new = _numbers(_Shard(shard, np.diff(offsets), every), name, every)
                steps += int(np.count_nonzero(of_new >= old_count))
            counts[f"new_{what}_steps"] = steps
        counts["expired_steps"] = sum(int(s.lengths[~s.kept].sum()) for s in self._shards)
        return counts

    def _record(
        self, new: StoreRecord, report: Mapping[str, Any], origin: Mapping[str, Any]
    ) -> StoreRecord:
        old, kept = self._old, [shard.lengths[shard.kept] for shard in self._kept]
        episodes, steps = sum(map(len, kept)), sum(int(lengths.sum()) for lengths in kept)
        dropped = dict(old.source.dropped)
        for reason, rows in report["dropped"].items():
            dropped[reason] = dropped.get(reason, 0) + rows
        first = report["time_range_ms"][0]
        if kept and old.source.time_range_ms is not None:
            times = [s.load(schema.TIMESTAMP)[s.of_steps(s.kept)].min() for s in self._kept]
            first = min(first, *map(int, times)) if report["expired_steps"] else None
            first = old.source.time_range_ms[0] if first is None else first
        source = {
            **old.source.model_dump(),
            "files": [*old.source.files, *map(str, report["files"])],
            "rows_read": (old.source.rows_read or 0) + report["rows_read"],
            "dropped": dropped,
            "steps": steps + new.n_steps,
            "time_range_ms": [first, report["time_range_ms"][1]],
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


def _numbers(shard: _Shard, name: str, episodes: BoolArray) -> IntArray:
    """Number of the user or item of every step of some episodes."""
    if name == schema.USER_ID:
        users = shard.load(schema.USER)[episodes]
        return np.repeat(users, shard.lengths[episodes]).astype(np.int64)
    rows = shard.of_steps(episodes)
    return np.asarray(shard.load(schema.ITEM)[rows], dtype=np.int64)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        # Another file system, or one without links.
        shutil.copyfile(source, target)
