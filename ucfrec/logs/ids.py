"""Users and items of a store: which ids there are, their numbers in its steps, and their files."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ucfrec import schema
from ucfrec.arrays import IntArray
from ucfrec.episodes.writer import StoreWriter
from ucfrec.logs.engine import BATCH_ROWS, as_numpy
from ucfrec.logs.measures import EPISODES
from ucfrec.logs.sessions import Cut, read_episodes
from ucfrec.logs.sorted_rows import CODES, ITEM, USER, SortedRows
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


def number_ids(
    log: TypedLog, listed: Mapping[str, Sequence[str]], like: Path | None, onto: Path | None = None
) -> None:
    """Create the tables `users` and `items`: id, its `number` in sorted order, `train_count`.

    Args:
        log: log with the tables of `ucfrec.logs.measures.count_ids`.
        listed: log column to feature tables whose column `id` lists more users or items.
        like: a store whose numbers are reused instead (without `train_count`); None for none.
        onto: a store whose ids keep their numbers, while others follow in sorted order; their
            `train_count` is added to the log's. None for none.
    """
    for name, table, file in ID_TABLES:
        if name not in log.columns:
            continue
        kind, store = log.id_type(name), like or onto
        old = f"SELECT NULL::{kind} AS {name}, 0 AS number, 0 AS train_count WHERE false"
        if store is not None:
            # Ids may be integers in the store and text in the log, or vice versa: 07 is not 7.
            cast = f"TRY_CAST({name} AS {kind})"
            same = f"CAST({cast} AS VARCHAR) = CAST({name} AS VARCHAR)"
            options = "file_row_number = true, hive_partitioning = false"
            source = f"read_parquet({text(glob_pattern(store / file))}, {options})"
            old = (
                f"SELECT CASE WHEN {same} THEN {cast} END AS {name}, file_row_number AS number, "
                f"{'0 AS ' if like else ''}train_count FROM {source}"
            )
        if like is not None:
            log.connection.execute(f"CREATE TABLE {table} AS {old}")
            continue
        ids = [f"SELECT {name} FROM used_{table}"]
        ids += [f"SELECT id FROM {other}" for other in listed[name]]
        log.connection.execute(f"""
            CREATE TABLE {table} AS
            WITH old AS ({old}),
            new AS (({" UNION ".join(ids)}) EXCEPT SELECT {name} FROM old),
            every AS (
                SELECT {name}, number, train_count FROM old UNION ALL
                SELECT {name}, (SELECT count(*) FROM old) + row_number() OVER (ORDER BY {name}) - 1,
                    0 FROM new
            )
            SELECT {name}, number, a.train_count + coalesce(b.train_count, 0) AS train_count
            FROM every AS a LEFT JOIN used_{table} AS b USING ({name})
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


def write_episode_users(log: TypedLog, file: Path) -> None:
    """Write the user of every episode, in the order of the store; after `number_ids`."""
    query = (
        f"SELECT {schema.USER_ID} FROM {EPISODES} JOIN user_codes ON code = {USER} ORDER BY episode"
    )
    _copy(log, query, file)


def _copy(log: TypedLog, query: str, file: Path) -> None:
    # DuckDB's COPY cannot write here: its connection may open only the scratch folder.
    reader = log.connection.sql(query).to_arrow_reader(BATCH_ROWS)
    with pq.ParquetWriter(file, reader.schema) as writer:
        for batch in reader:
            writer.write_batch(batch)


def write_steps(
    rows: SortedRows,
    cut: Cut,
    folder: Path,
    display: Progress,
    first_shard: int = 0,
    fill: Mapping[str, float] = MappingProxyType({}),
) -> StoreWriter:
    """Write all steps to the store at `folder`, after `number_ids`.

    Users and items that the store does not know have the number −1.

    Args:
        fill: the step columns of the store, with what steps without a value have; others are left
            out. Empty for those of the log.
    """
    log, writer = rows.log, StoreWriter(folder, first_shard=first_shard)
    users = _read_numbers(log, "users", schema.USER_ID)
    items = _read_numbers(log, "items", schema.ITEM_ID) if log.key == schema.ITEM_ID else users
    for episodes in read_episodes(rows, cut):
        columns, lengths = episodes.rows, episodes.lengths
        if ITEM in columns:
            columns[schema.ITEM] = items[columns[ITEM]]
        if rows.observations is not None:
            columns[schema.OBSERVATION] = rows.observations.of_rows(columns["row"])
        names = [n for n in schema.STEP_DTYPES if n in columns and (n in fill or not fill)]
        steps = {name: columns[name] for name in names}
        count = int(lengths.sum())
        steps |= {n: np.full(count, value) for n, value in fill.items() if n not in steps}
        first = np.zeros(count, dtype=bool)
        first[np.cumsum(lengths) - lengths] = True
        values = {
            schema.USER: users[episodes.users],
            schema.SPLIT: episodes.splits,
            schema.TERMINATED: episodes.terminated,
        }
        writer.append(steps, first, {n: np.repeat(v, lengths) for n, v in values.items()})
        display.update(count)
    return writer


def _read_numbers(log: TypedLog, table: str, name: str) -> IntArray:
    """Number in a table of each id by code; −1 for others, and for ids in no step."""
    codes, _ = CODES[name]
    (size,) = log.one(f"SELECT count(*) FROM {codes}")
    numbers = np.full(size, -1, dtype=np.int32)
    query = f"SELECT code, CAST(number AS INTEGER) FROM used_{table} JOIN {table} USING ({name})"
    for batch in log.connection.sql(query).to_arrow_reader(BATCH_ROWS):
        numbers[as_numpy(batch.column(0))] = as_numpy(batch.column(1))
    return numbers
