"""Read the features of items and users into DuckDB tables."""

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import duckdb
import numpy as np

from ucfrec.errors import InputError, InputNote
from ucfrec.logs.binding import Bound, bind, explained, wrong_type
from ucfrec.logs.engine import BATCH_ROWS
from ucfrec.logs.mapping import FeatureTable, LogMapping, is_table, log_files
from ucfrec.logs.tables import (
    NOTHING,
    PANDAS_INDEX,
    Table,
    as_timestamp,
    is_integer,
    is_number,
    is_vector,
    open_tables,
    quoted,
    raw_name,
)

_WHOLE: Final = {"FLOAT": 2**24, "DOUBLE": 2**53}
"""DuckDB type of reals to the bound below which it holds every whole number."""

_MANY_LACKING: Final = 0.2
"""Share of the ids without a row above which a note says so."""


@dataclass(frozen=True)
class _Part:
    """Files of a feature table with the same columns."""

    table: Table
    key: Bound
    first_by: str
    features: dict[str, tuple[str, str]]
    """Feature, without regard to case, to its (SQL, type)."""


def load_features(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    kind: str,
    id_type: str,
) -> list[str]:
    """Read feature tables into DuckDB tables `<kind>_features_0`, …, with columns `id`, `f0`, ….

    The parts of a table are joined by the names of their columns, whatever their order: what a part
    lacks is missing for its rows. A key is not a feature.

    Args:
        connection: engine that may open the tables' files.
        kind: "item_id" or "user_id".
        id_type: DuckDB type of the log's ids; rows whose key is none are excluded.

    Returns:
        Names of the DuckDB tables, one per feature table.

    Raises:
        InputError: a file or column cannot be used, two parts have a column of different types, or
            a table repeats an id.
    """
    names = []
    for number, table in enumerate(tables):
        name = f"{kind}_features_{number}"
        opened = open_tables(connection, log_files(table.files))
        parts = [_part(connection, part, table, kind) for part in opened]
        types = _common_types(parts, kind)
        rows_of_parts = " UNION ALL ".join(_select_rows(part, types, id_type) for part in parts)
        with explained(connection, opened, opened[0].files[0].parent):
            connection.execute(
                f"CREATE TABLE {name} AS SELECT * FROM ({rows_of_parts}) WHERE id IS NOT NULL"
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


def feature_digest(connection: duckdb.DuckDBPyConnection, names: Sequence[str]) -> str:
    """A digest of every id and value of feature tables, in whatever order their rows are.

    Args:
        names: of `load_features`.
    """
    digest = hashlib.sha256()
    for name in names:
        columns = connection.sql(f"DESCRIBE {name}").fetchall()
        digest.update(repr([(column[0], column[1]) for column in columns]).encode())
        rows = connection.sql(f"SELECT * FROM {name} ORDER BY id")
        for batch in rows.to_arrow_reader(BATCH_ROWS):
            for column in batch.columns:
                if str(column.type) == "double":
                    values = np.asarray(column.fill_null(np.nan))
                    digest.update(np.where(np.isnan(values), np.nan, values).tobytes())
                else:
                    digest.update("\n".join(map(repr, column.to_pylist())).encode())
    return digest.hexdigest()


def _part(
    connection: duckdb.DuckDBPyConnection, opened: Table, table: FeatureTable, kind: str
) -> _Part:
    key = bind(connection, opened, f"key of {kind} features", table.key)
    key_columns = {name.casefold() for name in key.columns}
    names = table.columns or tuple(
        name
        for name in opened.columns
        if name.casefold() not in key_columns and not PANDAS_INDEX.fullmatch(name)
    )
    # The text of a CSV file is what its keys are, not what DuckDB makes of it.
    raw = key.columns if key.is_column and not opened.columnar else ()
    if raw:
        key = Bound(quoted(raw_name(raw[0])), "VARCHAR", (), False)
    sources, features, first_by = [key], {}, ""
    for name in names:
        feature = bind(connection, opened, f"{kind} feature", name)
        comparable = _comparable(feature.sql, feature.kind)
        if comparable is None:
            remedy = "cast it to a number, text, or a list of either"
            raise wrong_type(opened, f"{kind} feature", name, feature.kind, remedy)
        features[name.casefold()] = comparable
        sources.append(feature)
    if table.first_by:
        order = bind(connection, opened, f"first_by of {kind} features", table.first_by)
        sources.append(order)
        first_by = order.sql
    columns = (column for source in sources for column in source.columns)
    return _Part(opened.of(columns, raw), key, first_by, features)


def _common_types(parts: Sequence[_Part], kind: str) -> dict[str, str]:
    """Feature to its type in all parts of a table.

    Raises:
        InputError: two parts differ.
    """
    types: dict[str, str] = {}
    files: dict[str, Path] = {}
    for part in parts:
        for name, (_, type_) in part.features.items():
            earlier = types.get(name, NOTHING)
            if earlier == NOTHING:
                types[name], files[name] = type_, part.table.files[0]
            elif type_ not in (earlier, NOTHING):
                raise InputError(
                    f"{part.table.files[0]}: {kind} feature {name} is {type_} here and {earlier} "
                    f"in {files[name]}; write it in one type"
                )
    return {name: "VARCHAR" if type_ == NOTHING else type_ for name, type_ in types.items()}


def _select_rows(part: _Part, types: dict[str, str], id_type: str) -> str:
    """SQL of the rows of a part: `id`, `f0`, …."""
    id_sql, first = _cast_id(part.key.sql, part.key.kind, id_type), ""
    columns = [
        f"CAST({part.features.get(name, ('NULL', ''))[0]} AS {type_})"
        for name, type_ in types.items()
    ]
    if part.first_by:
        # Ties are broken by the features, so that the order of rows does not matter.
        order = ", ".join([part.first_by, *columns])
        first = f" QUALIFY row_number() OVER (PARTITION BY {id_sql} ORDER BY {order}) = 1"
    values = "".join(f", {sql} AS f{index}" for index, sql in enumerate(columns))
    return f"SELECT {id_sql} AS id{values} FROM {part.table.sql}{first}"


def require_known_ids(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    names: Sequence[str],
    kind: str,
    kept: str,
    noted: bool = True,
) -> None:
    """Check that each feature table has a row of an id of the log; note if many ids have none.

    Args:
        names: of `load_features`, for each of them.
        kind: "item_id" or "user_id".
        kept: table of the log's ids, in the column `kind`.
        noted: whether there is a note; see `note_lacking` for a store that grows.

    Raises:
        InputError: none of the ids of a table occurs in the log.
    """
    for table, name in zip(tables, names, strict=True):
        count = _count(connection, kept)
        without_row = _count(connection, f"{kept} ANTI JOIN {name} ON id = {kind}")
        files = ", ".join(map(str, table.files))
        if without_row == count:
            ids, log_ids = (
                connection.sql(f"SELECT {column} FROM {rows} ORDER BY 1 LIMIT 3").fetchall()
                for column, rows in (("id", name), (kind, kept))
            )
            keys = f"is {_list_values(ids)}" if ids else "is never such an id"
            raise InputError(
                f"{files}: no row belongs to a {kind} of the log, which "
                f"are {_list_values(log_ids)}, and {table.key} {keys}; let the key be an "
                "expression that gives the same ids, or leave the file out"
            )
        if noted and without_row > _MANY_LACKING * count:
            warnings.warn(
                f"{files}: {without_row:,} of {count:,} {kind}s of the log have no row; their "
                "features count as missing",
                InputNote,
                stacklevel=3,
            )


def note_lacking(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    names: Sequence[str],
    kind: str,
    new: str,
    lost: str,
) -> None:
    """Note the new ids of a store that grows which feature tables say nothing of.

    Args:
        tables: feature tables; none where none is given now.
        names: of `load_features`, for each of them.
        kind: "item_id" or "user_id".
        new: SQL of the new ids of the log, in the column `kind`.
        lost: the store, if it was made with such tables; empty otherwise.
    """
    count, ids = _count(connection, f"({new})"), kind.removesuffix("_id")
    what = "embeddings" if ids == "item" else "features"
    notes = []
    if lost and count and not tables:
        notes.append(
            f"{lost} was prepared with {ids} features and none are given now: the {what} of all "
            f"{count:,} new {ids}s begin at the mean"
        )
    for table, name in zip(tables, names, strict=True):
        without_row = _count(connection, f"({new}) ANTI JOIN {name} ON id = {kind}")
        if without_row:
            notes.append(
                f"{', '.join(map(str, table.files))}: {without_row:,} of {count:,} new {ids}s have "
                f"no row in the {ids} features; their {what} say nothing of them"
            )
    for note in notes:
        warnings.warn(f"{note}; give a current table with --mapping", InputNote, stacklevel=3)


def _count(connection: duckdb.DuckDBPyConnection, rows: str) -> int:
    ((count,),) = connection.sql(f"SELECT count(*) FROM {rows}").fetchall()
    return int(count)


def _list_values(rows: Sequence[tuple[object, ...]]) -> str:
    return ", ".join([*(f"{value!r:.40}" for (value,) in rows), "…"])


def _cast_id(key: str, key_type: str, id_type: str) -> str:
    """SQL that casts a key to an id type, NULL where no cast does."""
    if is_number(key_type) and not is_integer(key_type):
        # 12.0 is the text '12' and no other; a cast of 12.4 would round it to another id, as the
        # file did with whole numbers that its type does not hold.
        exact = f"AND abs({key}) < {_WHOLE[key_type]}" if key_type in _WHOLE else ""
        key = f"CASE WHEN {key} = trunc({key}) {exact} THEN TRY_CAST({key} AS HUGEINT) END"
    elif id_type == "BIGINT" and not is_integer(key_type):
        # Text is an integer only if it is written as the integer is: 007 is not 7.
        number = f"TRY_CAST({key} AS BIGINT)"
        return f"CASE WHEN CAST({number} AS VARCHAR) = CAST({key} AS VARCHAR) THEN {number} END"
    as_id = f"TRY_CAST({key} AS {id_type})"
    # Text without a character is missing, as in the log.
    return as_id if id_type == "BIGINT" else f"nullif({as_id}, '')"


def _comparable(sql: str, kind: str) -> tuple[str, str] | None:
    """SQL that casts a feature to DOUBLE, VARCHAR, VARCHAR[] or FLOAT[], and that type; None if no
    cast does."""
    if kind == NOTHING:
        return "NULL", NOTHING
    if is_number(kind):
        # Undefined numbers, such as the logarithm of 0, are missing.
        return f"TRY(CAST({sql} AS DOUBLE))", "DOUBLE"
    if time := as_timestamp(sql, kind):
        return f"epoch({time}) / 86400", "DOUBLE"
    if kind in ("VARCHAR", "BOOLEAN", "UUID") or kind.startswith("ENUM"):
        return f"CAST({sql} AS VARCHAR)", "VARCHAR"
    if is_vector(kind) and not is_integer(kind.partition("[")[0]):
        return f"CAST({sql} AS FLOAT[])", "FLOAT[]"
    if kind.endswith("[]"):
        return f"CAST({sql} AS VARCHAR[])", "VARCHAR[]"
    return None


def note_unread_features(files: Sequence[Path], mapping: LogMapping) -> None:
    """Note a table called `items.*` or `users.*` beside a log that was named alone.

    Args:
        files: of the log.
    """
    folders = dict.fromkeys(file.parent for file in files)
    for name, tables in (("items", mapping.item_features), ("users", mapping.user_features)):
        beside = (file for folder in folders for file in sorted(folder.glob(f"{name}.*")))
        table = next((file for file in beside if is_table(file) and file not in files), None)
        if table is not None and not tables:
            warnings.warn(
                f"{table} lies beside the log and is not read; if it holds features of {name}, "
                f"name the folder {table.parent}, or the file too",
                InputNote,
                stacklevel=2,
            )
