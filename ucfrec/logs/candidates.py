"""Sets of candidates: what decisions of a log chose from, each distinct set once."""

from collections.abc import Sequence
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xxhash

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.errors import InputError, warn_user
from ucfrec.files.atomic import atomic_file
from ucfrec.logs.engine import bind, text_of_column, to_arrow, wrong_type
from ucfrec.logs.mapping import LogMapping, log_files, sets_beside
from ucfrec.logs.tables import NOTHING, first_and_more, is_integer, open_tables
from ucfrec.logs.typed import KEY_OF_LIST, TypedLog

ITEMS = "items"
"""Column of a table of sets: the ids in a set, whose name is in the column `candidates`."""


def name_set(candidates: Array | None) -> str:
    """16 hexadecimal digits that name a set of ids, in any order; empty for None, everything."""
    if candidates is None:
        return ""
    # Ids in the order of a catalogue are sorted in a third of the time; a set would lose it.
    texts = sorted(dict.fromkeys(map(str, candidates.tolist())))
    return xxhash.xxh3_64_hexdigest("\n".join(texts).encode())


def list_set_files(mapping: LogMapping, files: Sequence[Path]) -> list[Path]:
    """Tables of sets that a mapping names, and those beside log files."""
    stated = log_files(mapping.candidate_sets) if mapping.candidate_sets else ()
    beside = (sets_beside(file) for file in files)
    return list(dict.fromkeys([*stated, *(file for file in beside if file.is_file())]))


def number_sets(log: TypedLog, older: IntArray) -> tuple[IntArray, IntArray] | None:
    """Number the sets of candidates of a log, after `number_ids`; None if no row has one.

    Sets of `older`, as of `Offers.sets`, keep their numbers; others follow, ordered by their items.

    Returns (K + 1,) the set of each code of candidates, −1 for none and for a set without a
    known item, of which a note says how many; and (2, C) all sets, as of `Offers.sets`. Raises
    InputError if a table of sets cannot be used, or a row names a set that is in none.
    """
    connection = log.connection
    if schema.CANDIDATES not in log.columns:
        return None
    (n_codes,) = log.one("SELECT count(*) FROM candidate_codes")
    if not n_codes:
        return None
    connection.register("older_sets", pa.record_batch([*map(to_arrow, older)], ["number", "item"]))
    _load_sets_of(log)
    unnamed, example = log.one(
        f"SELECT count(*), min({schema.CANDIDATES}) FROM candidate_codes "
        f"ANTI JOIN named_sets USING ({schema.CANDIDATES})"
    )
    if unnamed:
        raise InputError(
            f"{log.name}: {unnamed:,} sets that {schema.CANDIDATES} names (such as {example!r:.60})"
            " are in no table; name the tables of sets in the mapping (candidate_sets), read text "
            f"of lists with --column {schema.CANDIDATES}='COLUMN::VARCHAR[]', or ignore the column "
            f"with --column {schema.CANDIDATES}="
        )
    n_older = int(older[0].max(initial=-1)) + 1
    connection.execute(f"""
        CREATE TABLE numbered_sets AS
        WITH new AS (
            SELECT code, list_sort(list(DISTINCT CAST(number AS BIGINT))) AS members
            FROM (SELECT *, unnest({ITEMS}) AS id FROM named_sets)
            JOIN candidate_codes USING ({schema.CANDIDATES})
            JOIN items ON id = CAST({schema.ITEM_ID} AS VARCHAR) GROUP BY code
        ),
        old AS (SELECT number, list(item ORDER BY item) AS members FROM older_sets GROUP BY number)
        SELECT code, members, coalesce(number, {n_older - 1} + dense_rank() OVER
            (PARTITION BY number IS NULL ORDER BY members)) AS number
        FROM new LEFT JOIN old USING (members)
    """)
    (unknown,) = log.one(
        f"SELECT count(*) FROM named_sets JOIN candidate_codes USING ({schema.CANDIDATES}) "
        f"ANTI JOIN numbered_sets USING (code) WHERE len({ITEMS}) > 0"
    )
    if unknown:
        which = f"{unknown:,} of {n_codes:,} sets of {schema.CANDIDATES} have no item of the store"
        warn_user(f"{log.name}: {which} and count as all items; write ids as in item_id")
    numbers = np.full(n_codes + 1, -1)
    numbered = connection.sql("SELECT code, number FROM numbered_sets").fetchnumpy()
    numbers[numbered["code"]] = numbered["number"]
    added = connection.sql(
        "SELECT number, unnest(any_value(members)) AS item FROM numbered_sets "
        f"WHERE number >= {n_older} GROUP BY number ORDER BY number, item"
    ).fetchnumpy()
    return numbers, np.hstack([older, np.stack([added["number"], added["item"]])])


def _load_sets_of(log: TypedLog) -> None:
    """Create the table `named_sets` of the sets that a log holds in lists or names."""
    connection, lists = log.connection, []
    for table in log.tables:
        text = text_of_column(connection, table, log.mapping, schema.CANDIDATES)
        value = bind(connection, table, f"for {schema.CANDIDATES}", text)
        if value.kind.endswith("[]") and NOTHING not in value.kind:
            lists.append(
                f"SELECT {KEY_OF_LIST.format(value.sql)} AS {schema.CANDIDATES}, "
                f"CAST(any_value({value.sql}) AS VARCHAR[]) AS {ITEMS} FROM {table.sql} GROUP BY 1"
            )
    files = [file for table in log.tables for file in table.files]
    load_named_sets(connection, list_set_files(log.mapping, files), lists)


def load_named_sets(
    connection: duckdb.DuckDBPyConnection, files: Sequence[Path], lists: Sequence[str] = ()
) -> None:
    """Create the table `named_sets` of the sets in tables of sets and in `lists` (SQL), each once:
    `candidates`, the name as text, and `items`, a list of text. Raises InputError if a table lacks
    these columns, or a name has several sets."""
    none = f"SELECT '' AS {schema.CANDIDATES}, CAST([] AS VARCHAR[]) AS {ITEMS} WHERE false"
    every = [none, *lists]
    for table in open_tables(connection, files) if files else ():
        name, ids = (bind(connection, table, "of sets", n) for n in (schema.CANDIDATES, ITEMS))
        kind, _, is_list = ids.kind.partition("[")
        if not (kind in ("VARCHAR", "UUID") or (is_list and is_integer(kind))):
            raise wrong_type(table, "of sets", ITEMS, ids.kind, "use a list of item_ids")
        columns = f"CAST({name.sql} AS VARCHAR), CAST({ids.sql} AS VARCHAR[])"
        every.append(f"SELECT {columns} FROM {table.sql}")
    connection.execute(
        f"CREATE TABLE named_sets AS SELECT {schema.CANDIDATES}, any_value({ITEMS}) AS {ITEMS}, "
        f"count(DISTINCT list_sort(list_distinct({ITEMS}))) > 1 AS differ "
        f"FROM ({' UNION ALL '.join(every)}) GROUP BY {schema.CANDIDATES}"
    )
    names = f"SELECT count(*), min({schema.CANDIDATES}) FROM named_sets WHERE differ"
    ((count, example),) = connection.sql(names).fetchall()
    if count:
        raise InputError(
            f"{first_and_more(files)}: {count:,} names of {schema.CANDIDATES} (such as "
            f"{example!r:.60}) have several sets; give every set a name of its own"
        )


def write_sets(log: Path, sets: pa.Table) -> None:
    """Write the sets of candidates that a file names beside it; none without any."""
    if sets.num_rows:
        with atomic_file(sets_beside(log)) as scratch:
            pq.write_table(sets, scratch)
