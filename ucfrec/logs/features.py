"""Encode the features of items and users as sparse matrices."""

from collections.abc import Sequence
from typing import Final, TypeAlias

import duckdb
import numpy as np
from scipy import sparse

from ucfrec.arrays import Array
from ucfrec.episodes.item_table import DISTINCT_TAGS, TAGS_PER_ITEM
from ucfrec.errors import InputError

CATEGORIES: Final = 200
"""Most categories or tags of one column: the most frequent among trained ids are kept."""
CLIP: Final = 5.0
"""Standardised numbers are clipped to ± this many standard deviations."""

Features: TypeAlias = sparse.csr_matrix


def encode_features(
    connection: duckdb.DuckDBPyConnection, names: Sequence[str], ids: str, id_column: str
) -> Features | None:
    """Encode feature tables; row i belongs to the id with `number` i in the table `ids`.

    Numbers are standardised and clipped, with 0 for missing ones; categories and tags are one-hot.
    Means, standard deviations and the kept categories come only from ids that occur in the
    training split (`train_count` above 0).

    Args:
        names: feature tables of `load_features`.
        ids: table with `number`, `train_count` and the ids.

    Returns:
        (n_ids, F) float32; None if no column has a feature.

    Raises:
        InputError: the vectors of a column differ in length.
    """
    ((count,),) = connection.sql(f"SELECT count(*) FROM {ids}").fetchall()
    blocks = []
    for name in names:
        joined = f"{ids} JOIN {name} ON {ids}.{id_column} = {name}.id"
        for column, kind, *_ in connection.sql(f"DESCRIBE {name}").fetchall()[1:]:
            block = _encode(connection, joined, column, kind, count)
            if block.shape[1]:
                blocks.append(block)
    return sparse.hstack(blocks, format="csr", dtype=np.float32) if blocks else None


def item_tags(
    connection: duckdb.DuckDBPyConnection, names: Sequence[str], ids: str, id_column: str
) -> Array:
    """Number the tags of items; row i belongs to the id with `number` i in the table `ids`.

    The tags are the values of all columns of lists, the `DISTINCT_TAGS` most frequent ones. An item
    without any shares none.

    Args:
        names: feature tables of `load_features`.
        ids: table with `number` and the ids.

    Returns:
        (n_ids, T) int64, padded with −1, T at most `TAGS_PER_ITEM`, and 0 without tags.
    """
    ((count,),) = connection.sql(f"SELECT count(*) FROM {ids}").fetchall()
    cases = [
        f"SELECT number, '{name}.{column}:' || unnest(list_distinct({column})) AS tag "
        f"FROM {ids} JOIN {name} ON {ids}.{id_column} = {name}.id"
        for name in names
        for column, kind, *_ in connection.sql(f"DESCRIBE {name}").fetchall()[1:]
        if kind == "VARCHAR[]"
    ]
    if not cases:
        return np.zeros((count, 0), dtype=np.int64)
    rows = connection.sql(f"""
        WITH cases AS ({" UNION ALL ".join(cases)}),
        tags AS (
            SELECT tag, row_number() OVER (ORDER BY count(*) DESC, tag) - 1 AS tag_number
            FROM cases WHERE tag IS NOT NULL GROUP BY tag
            ORDER BY tag_number LIMIT {DISTINCT_TAGS}
        )
        SELECT number, tag_number,
            row_number() OVER (PARTITION BY number ORDER BY tag_number) - 1 AS place
        FROM cases JOIN tags USING (tag) QUALIFY place < {TAGS_PER_ITEM}
    """).fetchnumpy()
    places = rows["place"].astype(np.int64)
    tags = np.full((count, int(places.max(initial=-1)) + 1), -1, dtype=np.int64)
    tags[rows["number"].astype(np.int64), places] = rows["tag_number"]
    return tags


def _encode(
    connection: duckdb.DuckDBPyConnection, joined: str, column: str, kind: str, count: int
) -> Features:
    if kind in ("DOUBLE", "FLOAT[]"):
        vector = column if kind == "FLOAT[]" else f"[{column}]"
        return _numbers(connection, joined, column, vector, count)
    value = column if kind == "VARCHAR" else f"unnest(list_distinct({column}))"
    return _categories(connection, joined, value, count)


def _numbers(
    connection: duckdb.DuckDBPyConnection, joined: str, column: str, vector: str, count: int
) -> Features:
    sizes = connection.sql(
        f"SELECT DISTINCT len({vector}) FROM {joined} WHERE {column} IS NOT NULL"
    ).fetchall()
    if len(sizes) > 1:
        raise InputError(f"a vector feature has lists of unequal length {sizes}; make them equal")
    rows = connection.sql(
        f"SELECT number, train_count > 0 AS trained, {vector} AS value FROM {joined} "
        f"WHERE list_bool_and([coalesce(isfinite(v), false) FOR v IN {vector}]) ORDER BY number"
    ).to_arrow_table()
    values = rows["value"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    numbers, trained = rows["number"].to_numpy(), rows["trained"].to_numpy()
    return _standardise(numbers, trained, values.reshape(-1, *(sizes[0] if sizes else (1,))), count)


def _standardise(rows: Array, trained: Array, values: Array, count: int) -> Features:
    training = values[trained.astype(bool)]
    if not len(training):
        return _sparse(values[:0, :0], rows[:0], rows[:0], (count, 0))
    deviation = training.std(axis=0)
    varied = deviation > 0
    scaled = (values - training.mean(axis=0))[:, varied] / deviation[varied]
    scaled = np.clip(scaled, -CLIP, CLIP).astype(np.float32)
    size = scaled.shape[1]
    columns = np.tile(np.arange(size), len(rows))
    return _sparse(scaled, np.repeat(rows, size), columns, (count, size))


def _categories(
    connection: duckdb.DuckDBPyConnection, joined: str, value: str, count: int
) -> Features:
    rows = connection.sql(f"""
        WITH cases AS (SELECT number, train_count, {value} AS value FROM {joined}),
        kept AS (
            SELECT value, row_number() OVER (ORDER BY count(*) DESC, value) - 1 AS column_index
            FROM cases WHERE train_count > 0 AND value IS NOT NULL
            GROUP BY value ORDER BY column_index LIMIT {CATEGORIES}
        )
        SELECT number, column_index FROM cases JOIN kept USING (value)
        ORDER BY number, column_index
    """).fetchnumpy()
    size = int(rows["column_index"].max(initial=-1)) + 1
    ones = np.ones(len(rows["number"]), dtype=np.float32)
    return _sparse(ones, rows["number"], rows["column_index"], (count, size))


def _sparse(values: Array, rows: Array, columns: Array, shape: tuple[int, int]) -> Features:
    return sparse.coo_matrix((values.ravel(), (rows, columns)), shape=shape).tocsr()
