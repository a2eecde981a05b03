"""Features of items and users, encoded as sparse matrices."""

from collections.abc import Sequence
from typing import Any, Final, TypeAlias

import duckdb
import numpy as np
import numpy.typing as npt
from scipy import sparse

from ucfrec.errors import InputError
from ucfrec.logs.binding import bind, is_integer, is_number, is_vector, open_tables, wrong_type
from ucfrec.logs.mapping import FeatureTable, log_files

CATEGORIES: Final = 200
"""Categories and tags kept of one column: the most frequent in the training window."""
CLIP: Final = 5.0
"""Standardised numbers are clipped here."""

Array = npt.NDArray[Any]
Features: TypeAlias = sparse.csr_matrix


def load_features(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    kind: str,
    id_type: str,
) -> list[str]:
    """Read feature tables into DuckDB tables `<kind>_features_0`, …, with columns `id`, `f0`, ….

    Args:
        kind: "item_id" or "user_id".
        id_type: DuckDB type of the log's ids.

    Returns:
        Names of the tables.

    Raises:
        InputError: a file or column cannot be used, or an id occurs twice.
    """
    names = []
    for place, table in enumerate(tables):
        name, selects = f"{kind}_features_{place}", []
        for opened in open_tables(connection, log_files(table.files)):
            key, _ = bind(connection, opened, f"key of {kind} features", table.key)
            given = table.columns or tuple(c for c in opened.columns if c != table.key)
            columns: list[str] = []
            for column in given:
                sql, type_ = bind(connection, opened, f"{kind} feature", column)
                comparable = _comparable(sql, type_)
                if comparable is None:
                    wanted = "cast it to a number, text, or a list of either"
                    raise wrong_type(opened, f"{kind} feature", column, type_, wanted)
                columns.append(comparable)
            id_sql, first = f"TRY_CAST({key} AS {id_type})", ""
            if table.first_by:
                by, _ = bind(connection, opened, f"first_by of {kind} features", table.first_by)
                # Days of one value are told apart by the features, whatever the order of rows.
                order = ", ".join([by, *columns])
                first = f" QUALIFY row_number() OVER (PARTITION BY {id_sql} ORDER BY {order}) = 1"
            named = ", ".join(f"{sql} AS f{number}" for number, sql in enumerate(columns))
            selects.append(f"SELECT {id_sql} AS id, {named} FROM {opened.sql}{first}")
        connection.execute(
            f"CREATE TABLE {name} AS SELECT * FROM ({' UNION ALL BY NAME '.join(selects)}) "
            "WHERE id IS NOT NULL"
        )
        ((rows, ids),) = connection.sql(
            f"SELECT count(*), count(DISTINCT id) FROM {name}"
        ).fetchall()
        if rows != ids:
            raise InputError(
                f"{', '.join(map(str, table.files))}: {rows - ids} of {rows} rows "
                f"repeat a {table.key}; keep one row a {kind}"
            )
        names.append(name)
    return names


def _comparable(sql: str, kind: str) -> str | None:
    """SQL that brings a feature to DOUBLE, VARCHAR, VARCHAR[] or FLOAT[]; None where none can."""
    if is_number(kind):
        return f"CAST({sql} AS DOUBLE)"
    if kind == "DATE" or kind.startswith("TIMESTAMP"):
        return f"epoch({sql}::TIMESTAMP) / 86400"
    if kind in ("VARCHAR", "BOOLEAN", "UUID") or kind.startswith("ENUM"):
        return f"CAST({sql} AS VARCHAR)"
    if is_vector(kind) and not is_integer(kind.partition("[")[0]):
        return f"CAST({sql} AS FLOAT[])"
    if kind.endswith("[]"):
        return f"CAST({sql} AS VARCHAR[])"
    return None


def encode_features(
    connection: duckdb.DuckDBPyConnection, names: Sequence[str], ids: str, id_column: str
) -> Features | None:
    """Encode feature tables, one row an id of the table `ids`, in the order of its `number`.

    Means, deviations and the choice of categories come from ids of the training window
    (`train_count` above 0). Numbers are standardised and clipped, 0 where missing; categories and
    tags are one-hot.

    Returns:
        (n_ids, F) float32; None without any feature.
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


def _encode(
    connection: duckdb.DuckDBPyConnection, joined: str, column: str, kind: str, count: int
) -> Features:
    if kind == "DOUBLE":
        return _numbers(connection, joined, column, count)
    if kind == "FLOAT[]":
        return _vectors(connection, joined, column, count)
    value = column if kind == "VARCHAR" else f"unnest(list_distinct({column}))"
    return _categories(connection, joined, value, count)


def _numbers(
    connection: duckdb.DuckDBPyConnection, joined: str, column: str, count: int
) -> Features:
    found = connection.sql(
        f"SELECT number, train_count > 0 AS trained, {column} AS value FROM {joined} "
        f"WHERE isfinite({column}) ORDER BY number"
    ).fetchnumpy()
    return _standardised(found["number"], found["trained"], found["value"][:, None], count)


def _vectors(
    connection: duckdb.DuckDBPyConnection, joined: str, column: str, count: int
) -> Features:
    sizes = connection.sql(
        f"SELECT DISTINCT len({column}) FROM {joined} WHERE {column} IS NOT NULL"
    ).fetchall()
    if len(sizes) != 1:
        raise InputError(f"a vector feature has lists of unequal length {sizes}; make them equal")
    found = connection.sql(
        f"SELECT number, train_count > 0 AS trained, {column} AS value FROM {joined} "
        f"WHERE list_bool_and([coalesce(isfinite(v), false) FOR v IN {column}]) ORDER BY number"
    ).to_arrow_table()
    values = found["value"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    trained = found["trained"].to_numpy()
    return _standardised(found["number"].to_numpy(), trained, values.reshape(-1, *sizes[0]), count)


def _standardised(rows: Array, trained: Array, values: Array, count: int) -> Features:
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
    found = connection.sql(f"""
        WITH cases AS (SELECT number, train_count, {value} AS value FROM {joined}),
        kept AS (
            SELECT value, row_number() OVER (ORDER BY count(*) DESC, value) - 1 AS place
            FROM cases WHERE train_count > 0 AND value IS NOT NULL
            GROUP BY value ORDER BY place LIMIT {CATEGORIES}
        )
        SELECT number, place FROM cases JOIN kept USING (value) ORDER BY number, place
    """).fetchnumpy()
    size = int(found["place"].max()) + 1 if len(found["place"]) else 0
    ones = np.ones(len(found["number"]), dtype=np.float32)
    return _sparse(ones, found["number"], found["place"], (count, size))


def _sparse(values: Array, rows: Array, columns: Array, shape: tuple[int, int]) -> Features:
    return sparse.coo_matrix((values.ravel(), (rows, columns)), shape=shape).tocsr()
