"""Read the features of items and users into DuckDB tables."""

from collections.abc import Sequence
from typing import Final

import duckdb

from ucfrec.errors import InputError
from ucfrec.logs.binding import (
    as_timestamp,
    bind,
    is_integer,
    is_number,
    is_vector,
    open_tables,
    wrong_type,
)
from ucfrec.logs.mapping import FeatureTable, log_files

_WHOLE: Final = {"FLOAT": 2**24, "DOUBLE": 2**53}
"""DuckDB type of reals to the bound below which it holds every whole number."""


def load_features(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    kind: str,
    id_type: str,
) -> list[str]:
    """Read feature tables into DuckDB tables `<kind>_features_0`, …, with columns `id`, `f0`, ….

    Args:
        connection: engine that may open the tables' files.
        tables: feature tables of the mapping.
        kind: "item_id" or "user_id".
        id_type: DuckDB type of the log's ids; rows whose key is none are left out.

    Returns:
        Names of the DuckDB tables, one per feature table.

    Raises:
        InputError: a file or column cannot be used, or a table repeats an id.
    """
    names = []
    for number, table in enumerate(tables):
        name, selects = f"{kind}_features_{number}", []
        for opened in open_tables(connection, log_files(table.files)):
            key, key_type = bind(connection, opened, f"key of {kind} features", table.key)
            given = table.columns or tuple(c for c in opened.columns if c != table.key)
            columns: list[str] = []
            for column in given:
                sql, type_ = bind(connection, opened, f"{kind} feature", column)
                comparable = _comparable(sql, type_)
                if comparable is None:
                    wanted = "cast it to a number, text, or a list of either"
                    raise wrong_type(opened, f"{kind} feature", column, type_, wanted)
                columns.append(comparable)
            id_sql, first = _as_id(key, key_type, id_type), ""
            if table.first_by:
                by, _ = bind(connection, opened, f"first_by of {kind} features", table.first_by)
                # Ties are broken by the features, so that the order of rows does not matter.
                order = ", ".join([by, *columns])
                first = f" QUALIFY row_number() OVER (PARTITION BY {id_sql} ORDER BY {order}) = 1"
            named = ", ".join(f"{sql} AS f{index}" for index, sql in enumerate(columns))
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
                f"repeat a {table.key}; keep one row per {kind}"
            )
        names.append(name)
    return names


def require_known_ids(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    names: Sequence[str],
    kind: str,
    kept: str,
) -> None:
    """Check that each feature table has a feature of an id of the log.

    Args:
        connection: engine with the tables.
        tables: feature tables of the mapping.
        names: of `load_features`, for each of them.
        kind: "item_id" or "user_id".
        kept: table of the log's ids, in the column `kind`.

    Raises:
        InputError: none of the ids of a table occurs in the log.
    """
    for table, name in zip(tables, names, strict=True):
        found = connection.sql(f"SELECT 1 FROM {name} JOIN {kept} ON id = {kind} LIMIT 1")
        if not found.fetchall():
            ids = connection.sql(f"SELECT id FROM {name} ORDER BY id").limit(3).fetchall()
            known = connection.sql(f"SELECT {kind} FROM {kept} ORDER BY {kind}").limit(3).fetchall()
            theirs = f"is {_listed(ids)}" if ids else "is never such an id"
            raise InputError(
                f"{', '.join(map(str, table.files))}: no row belongs to a {kind} of the log, which "
                f"are {_listed(known)}, and {table.key} {theirs}; let the key be an expression "
                "that gives the same ids, or leave the file out"
            )


def _listed(rows: Sequence[tuple[object, ...]]) -> str:
    return ", ".join([*(f"{value!r:.40}" for (value,) in rows), "…"])


def _as_id(key: str, key_type: str, id_type: str) -> str:
    """SQL that casts a key to an id type, NULL where no cast does."""
    if is_number(key_type) and not is_integer(key_type):
        # 12.0 is the text '12' and no other; a cast of 12.4 would round it to another id, as the
        # file did with whole numbers that its type does not hold.
        exact = f"AND abs({key}) < {_WHOLE[key_type]}" if key_type in _WHOLE else ""
        key = f"CASE WHEN {key} = trunc({key}) {exact} THEN TRY_CAST({key} AS HUGEINT) END"
    return f"TRY_CAST({key} AS {id_type})"


def _comparable(sql: str, kind: str) -> str | None:
    """SQL that casts a feature to DOUBLE, VARCHAR, VARCHAR[] or FLOAT[]; None if no cast does."""
    if is_number(kind):
        # Undefined numbers, such as the logarithm of 0, are missing.
        return f"TRY(CAST({sql} AS DOUBLE))"
    if time := as_timestamp(sql, kind):
        return f"epoch({time}) / 86400"
    if kind in ("VARCHAR", "BOOLEAN", "UUID") or kind.startswith("ENUM"):
        return f"CAST({sql} AS VARCHAR)"
    if is_vector(kind) and not is_integer(kind.partition("[")[0]):
        return f"CAST({sql} AS FLOAT[])"
    if kind.endswith("[]"):
        return f"CAST({sql} AS VARCHAR[])"
    return None
