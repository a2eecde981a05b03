"""The usable rows of a log in order of user, time and choice: one sort, then one pass.

The engine sorts, out of core; the pass over the sorted rows, in batches, drops faulty rows and
duplicates and writes the others to a spool with numbers in place of ids.
"""

import mmap
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

import duckdb
import numpy as np
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.logs.engine import as_numpy
from ucfrec.logs.kept import (
    REASONS,
    Digests,
    Hashes,
    digests,
    faults,
    in_hashed_order,
    kept_rows,
    require_rewards_in_range,
)
from ucfrec.logs.spool import Spool, whole_groups
from ucfrec.logs.typed import ROWS, WANTED, TypedLog

CODES: Final = {schema.USER_ID: "user_codes", schema.ITEM_ID: "item_codes"}
"""Id column to the table of its ids and their codes, numbers in the order of the ids."""
_SESSION_CODES: Final = "session_codes"
UNPLACED: Final = 128
"""Added to the fault of rows without a user or a time, which have no place in the order."""


class RowVectors:
    """The observation of every row of a log, in a file."""

    def __init__(self, log: TypedLog, file: Path) -> None:
        """
        Args:
            log: with observations, all of them finite.
            file: to write.
        """
        self._file, self._size = file, log.vector_size[schema.OBSERVATION]
        rows, query = 0, f"SELECT row, {schema.OBSERVATION} FROM {ROWS}"
        with file.open("xb") as out:
            for batch in log.connection.sql(query).to_arrow_reader(log.batch_rows):
                # What is at the place of a row must be its own: the engine keeps their order.
                places = as_numpy(batch.column(0))
                assert np.array_equal(places, np.arange(rows + 1, rows + 1 + len(places)))
                out.write(np.ascontiguousarray(as_numpy(batch.column(1).flatten())).data)
                rows += len(places)
        self._values: np.memmap[Any, np.dtype[np.float32]] = np.memmap(
            file, np.float32, "r", shape=(rows, self._size)
        )
        # Neighbours of a row in the file are hardly ever its neighbours in the order.
        self._advise("MADV_RANDOM")

    def _advise(self, advice: str) -> None:
        """Advise the system how the file is read; Windows takes no advice."""
        if hasattr(mmap, advice):
            self._map.madvise(getattr(mmap, advice))

    @property
    def _map(self) -> mmap.mmap:
        found = self._values._mmap  # type: ignore[attr-defined]
        assert isinstance(found, mmap.mmap)
        return found

    def of(self, rows: IntArray) -> Float32Array:
        """(M, O) observations of the rows at the positions (M,), from 1."""
        values = np.asarray(self._values[rows - 1])
        # Pages of a mapped file count as the memory of a process that must keep to a limit.
        self._advise("MADV_DONTNEED")
        return values

    def joined(self, batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        """Batches with the column `row`, each with the observations of its rows; then the file is
        removed."""
        for batch in batches:
            values = self.of(as_numpy(batch.column("row")))
            numbers = pa.Array.from_buffers(pa.float32(), values.size, [None, pa.py_buffer(values)])
            column = pa.FixedSizeListArray.from_arrays(numbers, self._size)
            yield batch.append_column(schema.OBSERVATION, column)
        self._file.unlink()


@dataclass
class SortedRows:
    """The usable rows of a log, and what was found on the way."""

    log: TypedLog
    clean: Spool
    """Usable rows in order of user, time and hash: `user` (int64 in the order of the ids),
    `item` (code, int32) or `action`, `timestamp`, `reward` (float64) and, if the log has them,
    `session` (with sessions by session_id), `observation`, `propensity` (NaN if unknown) and
    `is_random`."""
    placed: Spool
    """All rows with a user and a time, in that order: `user`, `timestamp` and `row`, their position
    in the files."""
    items: int = 0
    """Number of items that have a code."""
    dropped: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))
    """Number of dropped rows by reason."""
    read: int = 0
    """Number of rows."""
    conflicts: int = 0
    """Number of duplicates with another reward than the row that is kept."""
    tied: int = 0
    """Number of usable rows that share their user and time."""
    first_ms: int = 0
    """Time of the earliest usable row."""
    last_ms: int = 0
    """Time of the latest usable row."""
    lowest: float = np.inf
    """Lowest reward."""
    highest: float = -np.inf
    """Highest reward."""

    def count(self, clean: dict[str, Array]) -> None:
        """Add usable rows to the counts."""
        times, rewards = clean[schema.TIMESTAMP], clean[schema.REWARD]
        if not len(times):
            return
        if not len(self.clean):
            self.first_ms = int(times[0])
        self.first_ms = min(self.first_ms, int(times.min()))
        self.last_ms = max(self.last_ms, int(times.max()))
        self.lowest = min(self.lowest, float(rewards.min()))
        self.highest = max(self.highest, float(rewards.max()))


def sorted_batches(
    log: TypedLog, known_items: Path | None, folder: Path | None
) -> Iterator[pa.RecordBatch]:
    """Sort every row of a log with DuckDB, and make the tables of codes.

    Args:
        log: its engine may open `known_items`.
        known_items: `items.parquet` of a store: rows with other items are dropped; None for all.
        folder: scratch folder, of the observations; None for a log in memory.

    Returns:
        Rows as of `in_order`.
    """
    for name, table in code_tables(log):
        log.connection.execute(f"CREATE TABLE {table} AS {coded_ids(name, ROWS)}")
    faulty = f"({with_faults(log, ROWS, faults(log, known_items))})"
    if schema.OBSERVATION not in log.columns or folder is None:
        return _read(log, in_order(log, faulty))
    vectors = RowVectors(log, folder / "observations.bin")
    return vectors.joined(_read(log, in_order(log, faulty, left_out=schema.OBSERVATION)))


def _read(log: TypedLog, query: str) -> Iterator[pa.RecordBatch]:
    yield from log.connection.sql(query).to_arrow_reader(log.batch_rows)


def check_sorted(
    log: TypedLog, batches: Iterator[pa.RecordBatch], duplicates: str, folder: Path | None
) -> SortedRows:
    """Check every row of a log.

    Args:
        log: its engine has the tables of `code_tables`.
        batches: all its rows, as `in_order` selects them.
        duplicates: key of `ucfrec.logs.kept.DUPLICATES`.
        folder: scratch folder of the spools; None for memory.

    Raises:
        InputError: a reward is too large to train with.
    """
    spools = [Spool(None if folder is None else folder / name) for name in ("clean", "placed")]
    rows = SortedRows(log, spools[0], spools[1])
    rewards = _Rewards()
    # The connection itself answers no query before the last batch of its rows.
    with closing(log.connection.cursor()) as asked:
        hashes = _hashes(log, asked)
        columns = (_columns(batch, log) for batch in batches)
        # Equal times of a user stay together.
        for batch in whole_groups(columns, "user", schema.TIMESTAMP):
            _check_batch(rows, batch, duplicates, hashes, rewards)
    if log.key == schema.ITEM_ID:
        (rows.items,) = log.one("SELECT count(*) FROM item_codes")
    require_rewards_in_range(log, rewards.large, len(rows.clean), rewards.largest)
    return rows


@dataclass
class _Rewards:
    """How large rewards are."""

    large: int = 0
    """Number of those that are too large."""
    largest: float = 0.0


def _check_batch(
    rows: SortedRows, batch: dict[str, Array], duplicates: str, hashes: Hashes, rewards: _Rewards
) -> None:
    rows.read += len(batch["fault"])
    placed = np.asarray(batch["fault"] < UNPLACED)
    rows.placed.append(_where(placed, {n: batch[n] for n in ("user", "timestamp", "row")}))
    reasons = list(REASONS)
    counts = np.bincount(batch["fault"] % UNPLACED, minlength=len(reasons) + 1)
    for reason, n in zip(reasons, counts[1:], strict=True):
        rows.dropped[reason] += int(n)
    usable = np.asarray(batch.pop("fault") == 0)
    batch = _where(usable, batch)
    kept = kept_rows(batch, duplicates)
    rows.conflicts += kept.conflicts
    rows.dropped["duplicate"] += kept.duplicates
    rows.dropped["reward_not_finite"] += kept.undefined
    order, tied = in_hashed_order(batch, kept.rows, hashes)
    rows.tied += tied
    good = {name: batch[name][order] for name in batch if name in _spooled(rows.log)}
    size = np.abs(good[schema.REWARD])
    rewards.large += int(np.count_nonzero(size > schema.LARGEST_REWARD))
    rewards.largest = max(rewards.largest, float(size.max(initial=0)))
    rows.count(good)
    rows.clean.append(good)


def _where(chosen: BoolArray, batch: dict[str, Array]) -> dict[str, Array]:
    if chosen.all():
        return batch
    return {name: values[chosen] for name, values in batch.items()}


def has_codes(log: TypedLog, name: str) -> bool:
    """Whether the ids of a column of the log have codes; others are their own."""
    return name == schema.ITEM_ID or log.id_type(name) != "BIGINT"


def code_tables(log: TypedLog) -> Iterator[tuple[str, str]]:
    """Id columns of the log that have codes, and the names of the tables of `coded_ids`."""
    for name, table in (*CODES.items(), (schema.SESSION_ID, _SESSION_CODES)):
        if name in log.columns and has_codes(log, name):
            yield name, table


# The SQL of `coded_ids` and `in_order` is run by DuckDB and by Spark, and means the same to both.


def coded_ids(name: str, rows: str) -> str:
    """SQL of the ids in a column of some typed rows: each with `code`, its place in their order."""
    return (
        f"SELECT {name}, CAST(row_number() OVER (ORDER BY {name}) - 1 AS BIGINT) AS code "
        f"FROM (SELECT DISTINCT {name} FROM {rows} WHERE {name} IS NOT NULL) AS ids"
    )


def with_faults(log: TypedLog, rows: str, conditions: Mapping[str, str]) -> str:
    """DuckDB's SQL of typed rows with `fault`: 0, or the number of the first fault from 1.

    Args:
        rows: relation of some of its typed rows.
        conditions: as from `ucfrec.logs.kept.faults`.
    """
    cases = " ".join(
        f"WHEN {sql} THEN {list(REASONS).index(reason) + 1}" for reason, sql in conditions.items()
    )
    unplaced = f"{schema.USER_ID} IS NULL OR {schema.TIMESTAMP} IS NULL"
    fault = f"CASE {cases} ELSE 0 END + CASE WHEN {unplaced} THEN {UNPLACED} ELSE 0 END"
    values = f"* EXCLUDE ({WANTED})" if log.has_condition else "*"
    query = f"SELECT {values}, CAST({fault} AS SMALLINT) AS fault FROM {rows}"
    if log.key == schema.ITEM_ID:
        return query
    zeros = [0.0] * log.vector_size[schema.ACTION]
    action = f"CASE WHEN fault = 0 THEN action ELSE {zeros}::FLOAT[] END AS action"
    return f"SELECT * REPLACE ({action}) FROM ({query})"


def in_order(log: TypedLog, rows: str, left_out: str = "") -> str:
    """SQL of typed rows with faults, with codes, in order, without missing values.

    Args:
        rows: relation of all its rows, as of `with_faults`; beside it are the tables of
            `code_tables`.
        left_out: a column that is not read.
    """
    coded = dict(code_tables(log))
    joins = "".join(f" LEFT JOIN {table} USING ({name})" for name, table in coded.items())
    number = {name: f"{table}.code" for name, table in coded.items()}
    user = number.get(schema.USER_ID, schema.USER_ID)
    columns = [f"coalesce({user}, 0) AS user", f"coalesce({schema.TIMESTAMP}, 0) AS timestamp"]
    if log.key == schema.ITEM_ID:
        columns.append(f"CAST(coalesce({number[log.key]}, -1) AS INTEGER) AS item")
    else:
        columns.append(schema.ACTION)
    if schema.SESSION_ID in log.columns:
        session = number.get(schema.SESSION_ID, schema.SESSION_ID)
        columns += [f"coalesce({session}, 0) AS session", f"{session} IS NULL AS no_session"]
    columns.append(f"coalesce({schema.REWARD}, CAST('nan' AS DOUBLE)) AS {schema.REWARD}")
    if schema.PROPENSITY in log.columns:
        nan = "CAST('nan' AS FLOAT)"
        columns.append(f"coalesce({schema.PROPENSITY}, {nan}) AS {schema.PROPENSITY}")
    others = (schema.OBSERVATION, schema.IS_RANDOM)
    columns += [c for c in others if c in log.columns and c != left_out]
    choice = schema.ITEM if log.key == schema.ITEM_ID else schema.ACTION
    return (
        f"SELECT {', '.join(columns)}, row, fault FROM {rows} AS faulty{joins} "
        f"ORDER BY 1, 2, {choice}"
    )


def _spooled(log: TypedLog) -> set[str]:
    names = {"user", "item", "action", "timestamp", "reward", "observation", "propensity"}
    names.add("is_random")
    return names | ({"session"} if log.session_by == schema.SESSION_ID else set())


def _columns(batch: pa.RecordBatch, log: TypedLog) -> dict[str, Array]:
    columns = {}
    for name in batch.schema.names:
        column = batch.column(name)
        if name in log.vector_size:
            columns[name] = as_numpy(column.flatten()).reshape(-1, log.vector_size[name])
        else:
            columns[name] = as_numpy(column)
    return columns


def _hashes(log: TypedLog, asked: duckdb.DuckDBPyConnection) -> Hashes:
    """Hashes by code, for which `asked` has the tables of `code_tables`."""
    users_have_codes = has_codes(log, schema.USER_ID)

    def of_codes(name: str, begin: int, end: int) -> Digests:
        query = (
            f"SELECT {name} FROM {CODES[name]} WHERE code BETWEEN {begin} AND {end} ORDER BY code"
        )
        return digests([each for (each,) in asked.execute(query).fetchall()])

    @cache
    def of_all_items() -> Digests:
        return of_codes(schema.ITEM_ID, 0, np.iinfo(np.int32).max)

    def of_users(codes: Array) -> Digests:
        if not users_have_codes:
            return digests(codes.tolist())
        begin = int(codes[0])
        found: Digests = of_codes(schema.USER_ID, begin, int(codes[-1]))[codes - begin]
        return found

    return Hashes(of_users, lambda codes: of_all_items()[codes])
