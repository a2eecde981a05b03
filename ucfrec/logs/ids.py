"""Users and items of a store: which ids there are, their numbers in its steps, and their files."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.episodes.writer import StoreWriter
from ucfrec.logs.engine import BATCH_ROWS, as_arrow, as_numpy
from ucfrec.logs.measures import Measures
from ucfrec.logs.sessions import Episodes
from ucfrec.logs.sorted_rows import CODES, has_codes
from ucfrec.logs.spool import Spool
from ucfrec.logs.tables import glob_pattern, text
from ucfrec.logs.typed import TypedLog
from ucfrec.progress import Progress

ITEMS_FILE: Final = "items.parquet"
USERS_FILE: Final = "users.parquet"
EPISODE_USERS: Final = "episode_users.parquet"
ID_TABLES: Final = (
    (schema.USER_ID, "users", USERS_FILE),
    (schema.ITEM_ID, "items", ITEMS_FILE),
)
"""Id column, its DuckDB table of ids and numbers, and the file of that table in the store."""
_SCHEMA: Final = pa.schema([("code", pa.int64()), ("train_count", pa.int64())])
_PLACED: Final = pa.schema([("place", pa.int64()), ("code", pa.int64())])


def number_ids(
    log: TypedLog,
    measures: Measures,
    listed: Mapping[str, Sequence[str]],
    like: Path | None,
    onto: Path | None = None,
) -> None:
    """Create the tables `users` and `items`: id, its `number` in sorted order, `train_count`.

    Also `kept_users` and `kept_items`: ids that occur in the steps, with their `code`.

    Args:
        log: log with the tables of `ucfrec.logs.sorted_rows.code_tables`.
        listed: log column to feature tables whose column `id` lists more users or items.
        like: a store whose numbers are reused instead (without `train_count`); None for none.
        onto: a store whose ids keep their numbers, while others follow in sorted order; their
            `train_count` is added to the log's. None for none.
    """
    for name, table, file in ID_TABLES:
        if name not in log.columns:
            continue
        _keep(log, measures, name, f"kept_{table}")
        if like is not None:
            options = "file_row_number = true, hive_partitioning = false"
            source = f"read_parquet({text(glob_pattern(like / file))}, {options})"
            # Ids may be integers in the store and text in the log, or vice versa: 07 is not 7.
            kind = log.id_type(name)
            cast = f"TRY_CAST({name} AS {kind})"
            same = f"CAST({cast} AS VARCHAR) = CAST({name} AS VARCHAR)"
            known = f"CASE WHEN {same} THEN {cast} END AS {name}"
            log.connection.execute(
                f"CREATE TABLE {table} AS SELECT {known}, file_row_number AS number FROM {source}"
            )
            continue
        ids = [f"SELECT {name} FROM kept_{table}"]
        ids += [f"SELECT id FROM {other}" for other in listed[name]]
        if onto is not None:
            _add_ids(log, name, table, onto / file, " UNION ".join(ids))
            continue
        log.connection.execute(f"""
            CREATE TABLE {table} AS
            SELECT {name}, row_number() OVER (ORDER BY {name}) - 1 AS number,
                coalesce(train_count, 0) AS train_count
            FROM ({" UNION ".join(ids)}) LEFT JOIN kept_{table} USING ({name})
        """)


def text_ids(store: Path | None) -> tuple[str, ...]:
    """Id columns that are text in a store; none without one."""
    if store is None:
        return ()
    return tuple(
        name
        for name, _, file in ID_TABLES
        if (store / file).is_file()
        if not pa.types.is_integer(pq.read_schema(store / file).field(name).type)
    )


def _add_ids(log: TypedLog, name: str, table: str, file: Path, ids: str) -> None:
    """Create a table of the ids in the file of a store, and then those that `ids` selects.

    Args:
        log: its ids are text where those of the store are, see `text_ids`.
    """
    options = "file_row_number = true, hive_partitioning = false"
    log.connection.execute(f"""
        CREATE TABLE {table} AS
        WITH old AS (
            SELECT CAST({name} AS {log.id_type(name)}) AS {name}, file_row_number AS number,
                train_count FROM read_parquet({text(glob_pattern(file))}, {options})
        ), new AS (({ids}) EXCEPT SELECT {name} FROM old)
        SELECT {name}, number, old.train_count + coalesce(k.train_count, 0) AS train_count
        FROM old LEFT JOIN kept_{table} k USING ({name})
        UNION ALL
        SELECT {name}, (SELECT count(*) FROM old) + row_number() OVER (ORDER BY {name}) - 1,
            coalesce(train_count, 0) FROM new LEFT JOIN kept_{table} USING ({name})
    """)


def _keep(log: TypedLog, measures: Measures, name: str, table: str) -> None:
    """Create a table of the ids in the steps: id, `code`, `train_count`."""
    if name == schema.ITEM_ID:
        kept = np.flatnonzero(measures.item_steps)
        counts = measures.item_train_steps[kept]
        batches = iter([_batch(kept, counts)])
    else:
        batches = _user_batches(measures.users)
    log.connection.register("counted", pa.RecordBatchReader.from_batches(_SCHEMA, batches))
    coded = has_codes(log, name)
    source = f"counted JOIN {CODES[name]} USING (code)" if coded else "counted"
    given = f"{name}, code" if coded else f"code AS {name}, code"
    log.connection.execute(f"CREATE TABLE {table} AS SELECT {given}, train_count FROM {source}")
    log.connection.unregister("counted")


def _batch(codes: IntArray, counts: IntArray) -> pa.RecordBatch:
    return pa.record_batch([as_arrow(codes), as_arrow(counts)], schema=_SCHEMA)


def _user_batches(users: Spool) -> Iterator[pa.RecordBatch]:
    for begin in range(0, len(users), BATCH_ROWS):
        end = min(begin + BATCH_ROWS, len(users))
        yield _batch(users.read("user", begin, end), users.read("train_count", begin, end))


def popularity(log: TypedLog, measures: Measures) -> IntArray:
    """Number of steps that show each item of the table `items`, (items,)."""
    query = "SELECT coalesce(code, -1) AS code FROM items LEFT JOIN kept_items USING (item_id)"
    codes = log.connection.sql(query).fetchnumpy()["code"].astype(np.int64)
    return np.asarray(np.append(measures.item_steps, 0)[codes])


def numbers(log: TypedLog, name: str, table: str) -> Iterator[IntArray]:
    """Numbers of the ids in the steps, in the order of their codes, in batches; −1 for unknown ids.

    Yields:
        (N,) int64; the code of an item that is in no step has no number.
    """
    query = (
        f"SELECT coalesce(number, -1) AS number FROM kept_{table} LEFT JOIN {table} USING ({name}) "
        "ORDER BY code"
    )
    for batch in log.connection.sql(query).to_arrow_reader(BATCH_ROWS):
        yield as_numpy(batch.column(0))


def write_ids(log: TypedLog, folder: Path) -> dict[str, list[Any]]:
    """Write `users.parquet` and `items.parquet`; returns a digest of each for the fingerprint."""
    digests: dict[str, list[Any]] = {}
    for name, table, file in ID_TABLES:
        if name not in log.columns:
            continue
        _copy(log, f"SELECT * EXCLUDE number FROM {table} ORDER BY number", folder / file)
        digest = hashlib.sha256()
        query = f"SELECT {name} FROM {table} ORDER BY number"
        for batch in log.connection.sql(query).to_arrow_reader(BATCH_ROWS):
            digest.update("\n".join(map(str, batch.column(0).to_pylist())).encode())
        digests[name] = [digest.hexdigest()]
    return digests


def write_episode_users(log: TypedLog, file: Path, codes: Iterator[IntArray]) -> None:
    """Write the user of every episode, in the order of the store.

    Args:
        log: after `number_ids`.
        codes: code of the user of each episode, in batches.
    """
    reader = pa.RecordBatchReader.from_batches(_PLACED, _placed(codes))
    log.connection.register("placed", reader)
    _copy(
        log,
        f"SELECT {schema.USER_ID} FROM placed JOIN kept_users USING (code) ORDER BY place",
        file,
    )
    log.connection.unregister("placed")


def _placed(codes: Iterator[IntArray]) -> Iterator[pa.RecordBatch]:
    begin = 0
    for batch in codes:
        places = np.arange(begin, begin + len(batch))
        yield pa.record_batch([as_arrow(places), as_arrow(batch)], schema=_PLACED)
        begin += len(batch)


def _copy(log: TypedLog, query: str, file: Path) -> None:
    # DuckDB's COPY cannot write here: its connection may open only the scratch folder.
    reader = log.connection.sql(query).to_arrow_reader(BATCH_ROWS)
    with pq.ParquetWriter(file, reader.schema) as writer:
        for batch in reader:
            writer.write_batch(batch)


@dataclass(frozen=True)
class StepNumbers:
    """The numbers that a store gives to the users and items of a log."""

    users: Spool
    """`number` of each user in the steps, in order; −1 for users that the store does not know."""
    items: IntArray
    """(items,) number of each item by code; −1 likewise, and for items in no step."""

    @classmethod
    def of(cls, log: TypedLog, measures: Measures, folder: Path) -> "StepNumbers":
        """The numbers in the tables of `ucfrec.logs.ids.number_ids`.

        Args:
            measures: of the log's episodes.
        """
        users = Spool(folder / "numbers")
        for batch in numbers(log, schema.USER_ID, "users"):
            users.append({"number": batch})
        items = np.full(len(measures.item_steps), -1, dtype=np.int64)
        if log.key == schema.ITEM_ID:
            found = numbers(log, schema.ITEM_ID, "items")
            items[np.flatnonzero(measures.item_steps)] = np.concatenate(list(found))
        return cls(users, items)


def write_steps(
    folder: Path,
    episodes: Iterable[Episodes],
    spool: Spool,
    numbered: StepNumbers,
    display: Progress,
    first_shard: int = 0,
    fill: Mapping[str, float] = MappingProxyType({}),
) -> StoreWriter:
    """Write all episodes to the store at `folder`.

    Args:
        fill: the step columns of the store, with what steps without a value have; others are left
            out. Empty for those of the log.
    """
    writer = StoreWriter(folder, first_shard=first_shard)
    names = [name for name in schema.STEP_DTYPES if name in spool.names]
    names = [name for name in names if name in fill or not fill]
    users_before, last_user = 0, None
    for found in episodes:
        if not len(found.lengths):
            continue
        steps: dict[str, Array] = {n: found.column(spool, n) for n in names}
        rows = int(found.lengths.sum())
        steps |= {n: np.full(rows, value) for n, value in fill.items() if n not in steps}
        if schema.ITEM in steps:
            steps[schema.ITEM] = numbered.items[steps[schema.ITEM]]
        new = np.append(found.users[0] != last_user, found.users[1:] != found.users[:-1])
        places = np.cumsum(new) - 1 + users_before
        first_place = int(places[0])
        values = numbered.users.read("number", first_place, int(places[-1]) + 1)
        users_before, last_user = int(places[-1]) + 1, found.users[-1]
        first = np.zeros(rows, dtype=bool)
        first[np.cumsum(found.lengths) - found.lengths] = True
        each = {
            schema.USER: values[places - first_place],
            schema.SPLIT: found.splits,
            schema.TERMINATED: found.terminated,
        }
        writer.append(steps, first, {n: np.repeat(v, found.lengths) for n, v in each.items()})
        display.update(len(first))
    return writer
