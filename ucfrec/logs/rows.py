"""Which rows of a log count, and in which order: one rule for files, frames and requests.

One ORDER BY, by DuckDB or by Spark, then one pass that compares a row with the one before. Rows of
one user at one time are ordered by a hash: a policy would predict any order such as that of ids.
"""

import hashlib
import io
import mmap
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from ucfrec import schema
from ucfrec.arrays import Array, BoolArray, Float32Array, IntArray
from ucfrec.errors import InputError
from ucfrec.logs.engine import to_numpy
from ucfrec.logs.tables import MAX_FLOAT, glob_pattern, quote
from ucfrec.logs.typed import ROWS, WANTED, TypedLog, not_finite

USER, ITEM, SESSION, CANDIDATE_SET = "user_code", "item_code", "session", "candidate_set"
"""Columns of the sorted rows: numbers of the ids, in the order of the ids."""
_REQUEST = "request"
"""Column of a hash of the request."""
CODES = {
    schema.USER_ID: ("user_codes", USER),
    schema.ITEM_ID: ("item_codes", ITEM),
    schema.SESSION_ID: ("session_codes", SESSION),
    schema.CANDIDATES: ("candidate_codes", CANDIDATE_SET),
}
"""Id column to the table of its ids, `code` and `hash`, and to the column of the sorted rows."""
FAULTY = "faulty"
"""View of all rows, as of `mark_faults`."""
HELD = "held"
"""Relation of rows that a store has already."""
FAULT_COUNTS = f"SELECT fault, count(*) FROM {FAULTY} GROUP BY fault"
PRIME = 2**31 - 1
USER_FACTOR = 7919
HASH = "CAST(conv(substr(md5(CAST({} AS STRING)), 1, 7), 16, 10) AS BIGINT)"
"""SQL of `hash_ids`, for Spark and, where `conv` is a macro, for DuckDB."""
TIE = f"((1 + ({{}} * {USER_FACTOR} + {{}}) % {PRIME - 1}) * (1 + {{}}) % {PRIME})"
"""SQL of the place of a row among those of one user and time, by the hash of the user, the time and
the hash of the item. Each user and time multiply by a number of their own, modulo a prime, so that
two items are as often in one order as in the other."""
DAY_MS = 86_400_000
DECISION_MS = 1_800_000
"""A longer pause between rows of one request parts them into two decisions."""
REASONS = {
    "left_out": "does not fulfil --where",
    "null_key": "user, item or action, time or session is missing",
    "clock_out_of_range": "time before 2000 (or --earliest, or the end of an updated store) or "
    "more than a day ahead of now",
    "not_before": "is not before the time of the requests",
    "vector_not_finite": "action is missing or holds NaN or infinity",
    "unknown_item": "item is not in the store",
    "duplicate": "repeats user, item or action, and time of another row, which is kept",
    "reward_not_finite": "reward is missing, NaN or infinite",
}
"""Reason to its description; a row is dropped for the first reason that applies."""


class RowVectors:
    """The observation of every row of a log, in a file or in memory, read at the end."""

    def __init__(
        self,
        batches: Iterable[pa.RecordBatch],
        size: int,
        file: Path | None,
    ) -> None:
        """Write to a file, or to memory, batches of `row`, from 1 on, and `observation`."""
        rows, self._file = 0, file
        with io.BytesIO() if file is None else file.open("xb") as out:
            for batch in batches:
                places = to_numpy(batch.column("row"))
                # What is at the place of a row must be its own: the engine keeps their order.
                assert np.array_equal(places, np.arange(rows + 1, rows + 1 + len(places)))
                out.write(to_numpy(batch.column(schema.OBSERVATION)).tobytes())
                rows += len(places)
            self._memory = out.getvalue() if isinstance(out, io.BytesIO) else b""
        self._shape = rows, size

    def read(self, rows: IntArray) -> Float32Array:
        """(M, O) observations of the rows at the positions (M,), from 1."""
        if self._file is None:
            return np.frombuffer(self._memory, np.float32).reshape(self._shape)[rows - 1]
        # Mapped anew each time: mapped pages count as memory of the process.
        mapped: np.memmap[Any, np.dtype[np.float32]] = np.memmap(
            self._file, np.float32, "r", shape=self._shape
        )
        if hasattr(mmap, "MADV_RANDOM"):  # neighbours in the file are hardly ever so in the order
            mapped._mmap.madvise(mmap.MADV_RANDOM)  # type: ignore[attr-defined]
        return np.array(mapped[rows - 1])


class RowFile:
    """Batches of rows, column by column, in a new scratch folder or (None) in memory."""

    def __init__(self, folder: Path | None) -> None:
        if folder is not None:
            folder.mkdir()
        self._folder = folder
        self._batches: list[dict[str, Array]] = []
        """In memory; with a folder, their columns have no values."""

    def append(self, batch: dict[str, Array]) -> None:
        """Append rows, the same columns every time."""
        if self._folder is not None:
            for name, values in batch.items():
                np.save(self._folder / f"{len(self._batches)}-{name}.npy", values)
            batch = dict.fromkeys(batch, np.empty(0))
        self._batches.append(batch)

    def read(self, *names: str) -> Iterator[dict[str, Array]]:
        """Some columns of the batches, or all, in order."""
        for number, batch in enumerate(self._batches):
            if self._folder is not None:
                begin = f"{self._folder}/{number}"
                batch = {name: np.load(f"{begin}-{name}.npy") for name in names or batch}
            yield batch


@dataclass
class SortedRows:
    """The usable rows of a log, and what was found on the way."""

    log: TypedLog
    file: RowFile
    """The rows in order of user and time, all of a user in one batch: `USER`, `ITEM` or `action`,
    `timestamp`, `reward` (float64), `row` (position in the files) and, if the log has them,
    `SESSION` (with sessions by session_id), `propensity` (NaN if unknown), `is_random`,
    `CANDIDATE_SET` (−1 for none), and `place`, in the row's decision."""
    observations: RowVectors | None
    dropped: dict[str, int]
    """Number of dropped rows by reason."""
    read: int
    """Number of rows. Those below count usable rows: no duplicates, with a finite reward."""
    count: int = 0
    conflicts: int = 0
    """Number of duplicates with another reward than the row that counts."""
    tied: int = 0
    """Number of rows that share their user and time."""
    repeated_positions: int = 0
    """Number of rows with a position that another row of their request has."""
    has_lists: bool = False
    """Whether some decision has several rows."""
    unsorted: int = 0
    """Number of rows that are in the files before the row that precedes them in time."""
    first_ms: int = np.iinfo(np.int64).max
    last_ms: int = 0
    """Times of the earliest and the latest row."""
    lowest: float = np.inf
    highest: float = -np.inf
    """Rewards."""
    large: int = 0
    """Number of rewards that are too large to train with."""

    def add(
        self,
        batch: dict[str, Array],
        duplicates: str,
        by_session: bool,
    ) -> None:
        """Add rows as of `order_rows`, all of their users; leave out duplicates, undefined rewards.
        With `by_session`, rows of a session follow each other: sessions of one user may overlap."""
        keys = (USER, schema.TIMESTAMP, ITEM if ITEM in batch else schema.ACTION)
        repeated = np.append(False, np.all([_equal_before(batch[key]) for key in keys], axis=0))
        if repeated.any():
            batch = self._put_winners_first(batch, repeated, duplicates)
            winners = np.arange(len(repeated)) - _count_since(~repeated)
            rewards = batch[schema.REWARD]
            lost, counted = rewards[repeated], rewards[winners[repeated]]
            equal = np.isclose(lost, counted, rtol=0, atol=0, equal_nan=True)
            self.conflicts += int(np.count_nonzero(~equal))
            self.dropped["duplicate"] += len(lost)
        undefined = np.isnan(batch[schema.REWARD]) & ~repeated
        self.dropped["reward_not_finite"] += int(np.count_nonzero(undefined))
        usable = ~(repeated | undefined)
        if not usable.all():
            batch = take_rows(batch, usable)
        if not usable.any():
            return
        times, rewards, rows = (batch[n] for n in (schema.TIMESTAMP, schema.REWARD, "row"))
        same_user = _equal_before(batch[USER])
        tied = np.concatenate([[False], same_user & _equal_before(times), [False]])
        self.tied += int(np.count_nonzero(tied[1:] | tied[:-1]))
        moved = same_user & (np.diff(times) > 0) & (np.diff(rows) < 0)
        self.unsorted += int(np.count_nonzero(moved))
        self.count += len(times)
        self.first_ms = min(self.first_ms, int(times.min()))
        self.last_ms = max(self.last_ms, int(times.max()))
        self.lowest = min(self.lowest, float(rewards.min()))
        self.highest = max(self.highest, float(rewards.max()))
        self.large += int(np.count_nonzero(np.abs(rewards) > schema.LARGEST_REWARD))
        if _REQUEST in batch:
            # Rows without a request stay in the order of their hashes.
            alone = batch[_REQUEST] < 0
            batch[_REQUEST] = np.where(alone, np.arange(-len(alone), 0), batch[_REQUEST])
            batch = take_rows(batch, _order_requests(batch))
            times = batch[schema.TIMESTAMP]
        if by_session:
            users, sessions = batch[USER], batch[SESSION]
            # Sessions are in the order of their first times.
            keys_of_sessions = (users.astype(np.int64) << 32) + sessions
            _, first, place = np.unique(keys_of_sessions, return_index=True, return_inverse=True)
            order = np.lexsort((sessions, times[first][place], users))
            batch = take_rows(batch, order)
        batch, repeated_positions = _place_in_lists(batch, by_session)
        self.repeated_positions += repeated_positions
        self.has_lists |= bool(batch[schema.PLACE].any())
        self.file.append(batch)

    def _put_winners_first(
        self,
        batch: dict[str, Array],
        repeated: BoolArray,
        duplicates: str,
    ) -> dict[str, Array]:
        """The rows with the one that counts as the first of those that repeat the one before."""
        places = np.flatnonzero(repeated | np.append(repeated[1:], False))
        some = take_rows(batch, places)
        if self.observations is not None:
            some[schema.OBSERVATION] = self.observations.read(some["row"])
        groups = np.cumsum(~repeated)[places]
        order = places[np.lexsort([*order_duplicates(some, duplicates), groups])]
        source = np.arange(len(repeated))
        source[places] = order
        return take_rows(batch, source)


def _order_requests(batch: dict[str, Array]) -> IntArray:
    """Rows by the time at which their request begins: rows of others may be between its own."""
    users, requests, times = (batch[name] for name in (USER, _REQUEST, schema.TIMESTAMP))
    order = np.lexsort((times, requests, users))
    users, requests, times = users[order], requests[order], times[order]
    same = _equal_before(users) & _equal_before(requests)
    begins = np.append(True, ~same | (np.diff(times) > DECISION_MS))
    starts = times[begins][np.cumsum(begins) - 1]
    return order[np.lexsort((requests, starts, users))]


def _place_in_lists(batch: dict[str, Array], by_session: bool) -> tuple[dict[str, Array], int]:
    """Rows in order, with their places in their decisions instead of requests and positions, and
    how many repeat a position of their decision, with which another one begins."""
    times = batch[schema.TIMESTAMP]
    repeated = 0
    positions = batch.pop(schema.POSITION, None)
    goes_on = _equal_before(batch[USER]) & _equal_before(batch.pop(_REQUEST, times))
    goes_on &= np.diff(times) <= DECISION_MS
    if by_session:
        goes_on &= _equal_before(batch[SESSION])
    begins = np.append(True, ~goes_on)
    if positions is not None:
        decisions = np.cumsum(begins)
        # Rows without a position repeat none. Complex numbers sort by their real parts first.
        alone = -0.5 - np.arange(len(times))
        keys = decisions + 1j * np.where(np.isfinite(positions), positions, alone)
        order = keys.argsort(kind="stable")
        first = np.append(True, ~_equal_before(keys[order]))
        if repeated := int((~first).sum()):
            occurrences = _count_since(first)[order.argsort()]
            order = np.lexsort((occurrences, times, decisions))
            batch, positions = take_rows(batch, order), positions[order]
            lists = np.maximum.accumulate((decisions * len(times) + occurrences)[order])
            begins = np.append(True, ~_equal_before(lists))
        batch = take_rows(batch, np.lexsort((positions, np.cumsum(begins))))
    return {**batch, schema.PLACE: _count_since(begins).astype("<i4")}, repeated


def _count_since(begins: BoolArray) -> IntArray:
    """(M,) number of rows since the last one that begins something, as the first does."""
    rows = np.arange(len(begins))
    return rows - np.maximum.accumulate(np.where(begins, rows, 0))


def take_rows(batch: Mapping[str, Array], rows: IntArray | BoolArray | slice) -> dict[str, Array]:
    """Some rows of columns, by their numbers, a mask or a slice."""
    return {name: values[rows] for name, values in batch.items()}


def _equal_before(values: Array) -> BoolArray:
    """(M − 1,) whether each of M values but the first is equal to the one before."""
    equal = values[1:] == values[:-1]
    return np.asarray(equal if equal.ndim == 1 else equal.all(axis=1))


def keep_users_whole(batches: Iterable[dict[str, Array]], user: str) -> Iterator[dict[str, Array]]:
    """The same rows in batches that end between two users, who are in the column `user`."""
    pending: dict[str, Array] = {}
    for batch in batches:
        if pending:
            ends = np.flatnonzero(~_equal_before(pending[user]))
            end = int(ends[-1]) + 1 if len(ends) else 0
            if end:
                yield take_rows(pending, slice(end))
            batch = {name: np.concatenate([pending[name][end:], batch[name]]) for name in batch}
        pending = batch
    if pending and len(pending[user]):
        yield pending


def sort_rows(
    log: TypedLog,
    known_items: Path | None,
    duplicates: str,
    folder: Path | None,
    by_session: bool = False,
    held: pa.Table | None = None,
) -> SortedRows:
    """Sort the rows of a log with DuckDB, `folder` for scratch (None for a log in memory).

    Rows with items that are not in `known_items` (`items.parquet` of a store) are dropped; those
    with the user, item and time of a row of `held` (ids are text) are duplicates.
    """
    connection = log.connection
    if held is not None:
        connection.register(HELD, held)
    marked = mark_faults(log, ROWS, known_items, held is not None)
    connection.execute(f"CREATE VIEW {FAULTY} AS {marked}")
    connection.execute("CREATE MACRO conv(digits, a, b) AS CAST('0x' || digits AS BIGINT)")
    for name, table in code_tables(log).items():
        connection.execute(f"CREATE TABLE {table} AS {code_ids(name, ROWS)}")
    counts = dict(connection.sql(FAULT_COUNTS).fetchall())

    def read(query: str) -> Iterator[pa.RecordBatch]:
        yield from connection.sql(query).to_arrow_reader(log.batch_rows)

    observations = read(f"SELECT row, {schema.OBSERVATION} FROM {ROWS}")
    batches = read(order_rows(log, FAULTY))
    return check_sorted(log, counts, observations, batches, duplicates, folder, by_session)


def code_tables(log: TypedLog) -> dict[str, str]:
    """Id columns of the log, and the tables of `code_ids`."""
    return {name: table for name, (table, _) in CODES.items() if name in log.columns}


def code_ids(name: str, rows: str) -> str:
    """SQL of the ids in a column of some typed rows: `code`, its place in their order, `hash`."""
    return (
        f"SELECT {name}, CAST(row_number() OVER (ORDER BY {name}) - 1 AS INTEGER) AS code, "
        f"{HASH.format(name)} AS hash "
        f"FROM (SELECT DISTINCT {name} FROM {rows} WHERE {name} IS NOT NULL) AS ids"
    )


def mark_faults(
    log: TypedLog,
    rows: str,
    known_items: Path | None,
    any_held: bool = False,
) -> str:
    """SQL of typed rows with `fault`: 0, or the number of the first, from 1. Actions get a hash.
    Items not in `known_items`, of a store, are a fault; with `any_held`, also rows of `HELD`."""
    latest = int(time.time() * 1000) + DAY_MS
    conditions = {"left_out": f"{WANTED} IS NOT TRUE"} if log.mapping.where is not None else {}
    conditions |= {
        "null_key": " OR ".join(f"{key} IS NULL" for key in log.required if key != schema.ACTION),
        "clock_out_of_range": f"timestamp NOT BETWEEN {log.mapping.earliest_ms} AND {latest}",
    }
    if log.mapping.before_ms is not None:
        conditions["not_before"] = f"timestamp >= {log.mapping.before_ms}"
    if schema.ACTION in log.vector_size:
        conditions["vector_not_finite"] = not_finite(schema.ACTION)
    if known_items is not None:
        source = f"read_parquet({quote(glob_pattern(known_items))}, hive_partitioning = false)"
        known_ids = f"SELECT CAST(item_id AS VARCHAR) FROM {source}"
        conditions["unknown_item"] = f"CAST({log.key} AS VARCHAR) NOT IN ({known_ids})"
    if any_held:
        names = (schema.USER_ID, schema.ITEM_ID, schema.TIMESTAMP)
        key = ", ".join(f"CAST({name} AS VARCHAR)" for name in names)
        conditions["duplicate"] = f"({key}) IN (SELECT {key} FROM {HELD})"
    cases = " ".join(
        f"WHEN {sql} THEN {list(REASONS).index(reason) + 1}" for reason, sql in conditions.items()
    )
    columns = [f"* EXCLUDE ({WANTED})" if log.mapping.where is not None else "*"]
    if log.key == schema.ACTION:
        text = f"md5(CAST({schema.ACTION} AS VARCHAR))"
        columns.append(f"CAST('0x' || left({text}, 7) AS BIGINT) AS action_hash")
    fault = f"CAST(CASE {cases} ELSE 0 END AS SMALLINT) AS fault"
    return f"SELECT {', '.join(columns)}, {fault} FROM {rows}"


def order_rows(log: TypedLog, rows: str) -> str:
    """SQL of the rows without a fault in order of user, time, the hash of `TIE` and choice, from a
    relation as of `mark_faults`, beside which are the tables of `code_tables`."""
    tables, optional = code_tables(log), (schema.SESSION_ID, schema.CANDIDATES)
    joins = [
        f"{'LEFT' if name in optional else ''} JOIN {table} USING ({name})"
        for name, table in tables.items()
    ]
    columns = {CODES[name][1]: f"{table}.code" for name, table in tables.items()}
    hashed = "item_codes.hash" if schema.ITEM_ID in tables else "action_hash"
    finite = f"abs({schema.REWARD}) <= {MAX_FLOAT}"
    columns |= {
        schema.TIMESTAMP: schema.TIMESTAMP,
        "tie": f"CAST({TIE.format('user_codes.hash', schema.TIMESTAMP, hashed)} AS INTEGER)",
        "reward": f"CASE WHEN {finite} THEN reward ELSE CAST('nan' AS DOUBLE) END",
        "row": "row",
    }
    if schema.SESSION_ID in tables:
        columns[SESSION] = f"coalesce({columns[SESSION]}, {2**31 - 1})"
    whole = (schema.ACTION, schema.IS_RANDOM, schema.EXCLUDES_SEEN)
    columns |= {name: name for name in whole if name in log.columns}
    if schema.SESSION_BEGAN in log.columns:
        columns[schema.SESSION_BEGAN] = f"coalesce({schema.SESSION_BEGAN}, -1)"
    if schema.CANDIDATES in tables:
        columns[CANDIDATE_SET] = f"coalesce({columns[CANDIDATE_SET]}, -1)"
    if schema.PROPENSITY in log.columns:
        columns[schema.PROPENSITY] = f"coalesce({schema.PROPENSITY}, CAST('nan' AS FLOAT))"
    if schema.REQUEST_ID in log.columns:
        # A row without a request is a decision of its own.
        columns[_REQUEST] = f"coalesce({HASH.format(schema.REQUEST_ID)}, -row)"
    if schema.POSITION in log.columns:
        columns[schema.POSITION] = f"coalesce({schema.POSITION}, CAST('inf' AS DOUBLE))"
    choice = ITEM if schema.ITEM_ID in tables else schema.ACTION
    values = ", ".join(f"{sql} AS {name}" for name, sql in columns.items())
    names = ", ".join(name for name in columns if name != "tie")
    return (
        f"SELECT {names} FROM (SELECT {values} FROM {rows} AS faulty {' '.join(joins)} "
        f"WHERE fault = 0) AS coded ORDER BY {USER}, {schema.TIMESTAMP}, tie, {choice}"
    )


def check_sorted(
    log: TypedLog,
    fault_counts: Mapping[int, int],
    observations: Iterable[pa.RecordBatch],
    batches: Iterable[pa.RecordBatch],
    duplicates: str,
    folder: Path | None,
    by_session: bool,
) -> SortedRows:
    """Check the sorted rows of a log, with numbers of all rows by `fault`.

    `observations` are as of `RowVectors` and read only of a log that has them, `batches` as of
    `order_rows` and read after these. Raises InputError if a reward is too large to train with.
    """
    vectors = None
    if schema.OBSERVATION in log.columns:
        file = None if folder is None else folder / "observations.bin"
        vectors = RowVectors(observations, log.vector_size[schema.OBSERVATION], file)
    rows = SortedRows(
        log,
        RowFile(None if folder is None else folder / "rows"),
        vectors,
        {reason: fault_counts.get(number, 0) for number, reason in enumerate(REASONS, 1)},
        sum(fault_counts.values()),
    )
    shapes = {name: (-1, size) for name, size in log.vector_size.items()}
    columns = (
        {n: to_numpy(batch.column(n)).reshape(shapes.get(n, -1)) for n in batch.schema.names}
        for batch in batches
    )
    for users in keep_users_whole(columns, USER):
        rows.add(users, duplicates, by_session)
    if rows.large:
        raise InputError(
            f"{log.tables[0].files[0]}: {rows.large:,} of {rows.count:,} rewards are beyond "
            f"±{schema.LARGEST_REWARD:g} (up to {max(rows.highest, -rows.lowest):.3g}), too large "
            "to train with in float32; divide them in the reward expression"
        )
    return rows


def choose_rows(rows: Mapping[str, Array], duplicates: str) -> IntArray:
    """(K,) positions of the rows of a log in memory that count, in order of user and time.

    `order_rows` and `SortedRows.add` do the same for logs of any size. `rows` are (N,) columns in
    any order: `user`, `item` (identifiers), `timestamp`, `reward`, `row` (position in the log) and
    perhaps those of `order_duplicates`.
    """
    users, times, rewards = rows["user"], rows[schema.TIMESTAMP], rows[schema.REWARD]
    finite = np.abs(rewards) <= MAX_FLOAT
    order = np.lexsort((times, users))
    apart = ~(_equal_before(times[order]) & _equal_before(users[order]))
    if apart.all():
        return order[finite[order]]
    tied = np.zeros(len(users), dtype=bool)
    tied[order[1:]] |= ~apart
    tied[order[:-1]] |= ~apart
    items, ties = np.zeros((2, len(users)), dtype=np.int64)
    ids, items[tied] = np.unique(rows[schema.ITEM][tied], return_inverse=True)
    names, places = np.unique(users[tied], return_inverse=True)
    of_users = hash_ids(names.tolist())
    multiplier = 1 + np.fmod(of_users[places] * USER_FACTOR + times[tied], PRIME - 1)
    ties[tied] = np.fmod(multiplier * (1 + hash_ids(ids.tolist())[items[tied]]), PRIME)
    keys = [users, times, ties, items]
    order = np.lexsort([*order_duplicates(rows, duplicates), *keys[::-1]])
    first = np.append(True, ~np.all([_equal_before(key[order]) for key in keys], axis=0))
    order = order[first & finite[order]]
    if schema.POSITION in rows:  # a list, in its order
        order = order[np.lexsort([rows[schema.POSITION][order], times[order], users[order]])]
    return order


def order_duplicates(rows: Mapping[str, Array], duplicates: str) -> list[Array]:
    """Keys for `numpy.lexsort` by which, of rows of one user, time and choice, the one that counts
    is the first: by the rule, then by other columns, so that the order of files does not matter."""
    rewards = rows[schema.REWARD]
    finite = np.abs(rewards) <= MAX_FLOAT
    rule = {"highest": -rewards, "lowest": rewards, "first": rows["row"], "last": -rows["row"]}
    keys = [~finite, np.where(finite, rule[duplicates], 0)]
    columns = [schema.OBSERVATION, schema.PROPENSITY, SESSION, schema.IS_RANDOM, CANDIDATE_SET]
    columns += [schema.POSITION, schema.SESSION_BEGAN, schema.EXCLUDES_SEEN, _REQUEST]
    for name in columns:
        if name in rows:
            keys += [*np.atleast_2d(rows[name].T)]
    return [rows["row"], *keys[::-1]]


def hash_ids(ids: Sequence[object]) -> IntArray:
    """(N,) `HASH` of the text of each identifier, below 2**28, so that 7 and '7' have one."""
    # Text of JSON may hold half a character.
    texts = (str(identifier).encode("utf-8", "surrogatepass") for identifier in ids)
    digests = (hashlib.md5(text, usedforsecurity=False).hexdigest() for text in texts)
    return np.asarray([int(digest[:7], 16) for digest in digests], dtype=np.int64)


def mix_bits(values: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """The finaliser of SplitMix64, which is one-to-one: each bit depends on all bits of a value."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
