"""Read the features of items and users into DuckDB tables."""

from collections.abc import Sequence

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
        id_type: DuckDB type of the log's ids; rows whose key cannot be cast to it are left out.

    Returns:
        Names of the DuckDB tables, one per feature table.

    Raises:
        InputError: a file or column cannot be used, or a table repeats an id.
    """
    names = []
    for number, table in enumerate(tables):
        name, selects = f"{kind}_features_{number}", []
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
