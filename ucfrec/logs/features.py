"""Features of items and users: tables that are read with a log, then sparse matrices."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import duckdb
import numpy as np

from ucfrec import schema
from ucfrec.arrays import Array, IntArray
from ucfrec.episodes.item_table import ALWAYS, DISTINCT_TAGS, OFFERS, TAGS_PER_ITEM
from ucfrec.errors import InputError, warn_user
from ucfrec.logs.candidates import number_sets
from ucfrec.logs.engine import BATCH_ROWS, Bound, bind, explain_errors, wrong_type
from ucfrec.logs.mapping import FeatureTable, log_files
from ucfrec.logs.sessions import ID_TABLES
from ucfrec.logs.summary import MANY
from ucfrec.logs.tables import (
    NOTHING,
    PANDAS_INDEX,
    WHOLE,
    Table,
    cast_integer,
    cast_timestamp,
    first_and_more,
    is_integer,
    is_number,
    is_vector,
    open_tables,
    quote_name,
    raw_name,
)
from ucfrec.logs.typed import AVAILABLE, TypedLog, cast_value

if TYPE_CHECKING:
    from scipy import sparse

    from ucfrec.episodes.offers import Offers

_KINDS = {"DOUBLE": "numbers", "VARCHAR": "categories", "VARCHAR[]": "tags", "FLOAT[]": "vectors"}
CATEGORIES = 200
"""Most categories or tags of one column: the most frequent among trained ids are kept."""
CLIP = 5.0
"""Standardised numbers are clipped to ± this many standard deviations."""


def load_features(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    kind: str,
    id_type: str,
) -> list[str]:
    """Read feature tables into DuckDB tables, whose names are returned, with columns `id`, `f0`, ….

    The parts of a table are joined by the names of their columns: what a part lacks is missing for
    its rows. `kind` is "item_id" or "user_id"; rows whose key is no id of the log's DuckDB type are
    excluded. InputError if a file or column cannot be used, two parts have a column of different
    types, or a table repeats an id.
    """
    names = [f"{kind}_features_{number}" for number in range(len(tables))]
    for name, table in zip(names, tables, strict=True):
        opened = open_tables(connection, log_files(table.files))
        types: dict[str, tuple[str, Path]] = {}
        parts = [_select_part(connection, part, table, kind, id_type, types) for part in opened]
        values = [
            f"CAST(f{n} AS {'VARCHAR' if type_ == NOTHING else type_}) AS f{n}"
            for n, (type_, _) in enumerate(types.values())
        ]
        rows = f"({' UNION ALL BY NAME '.join(parts)})"
        with explain_errors(connection, opened):
            times = [time for time in connection.sql(f"FROM {rows}").columns if time in AVAILABLE]
            columns = ", ".join(["id", *values, *times])
            connection.execute(
                f"CREATE TABLE {name} AS SELECT {columns} FROM {rows} WHERE id IS NOT NULL"
            )
        if times:
            _split_times(connection, name, table)
        counts = f"SELECT count(*), count(DISTINCT id) FROM {name}"
        ((count, ids),) = connection.sql(counts).fetchall()
        if count != ids:
            raise InputError(
                f"{', '.join(map(str, table.files))}: {count - ids} of {count} rows "
                f"repeat a {table.key}; keep one row per {kind}{' or equal features' * bool(times)}"
            )
    return names


def _split_times(connection: duckdb.DuckDBPyConnection, name: str, table: FeatureTable) -> None:
    """Move the times of a feature table to a table of their own, which may repeat an id."""
    begin, until = AVAILABLE
    connection.execute(
        f"CREATE TABLE {name}_times AS SELECT DISTINCT id, {begin}, {until} FROM {name}"
    )
    empty = _count(connection, f"{name}_times WHERE {begin} >= {until}")
    if empty:
        raise InputError(
            f"{', '.join(map(str, table.files))}: {empty:,} of {_count(connection, name):,} rows "
            "are available until a time that is not after that from which they are; correct them"
        )
    connection.execute(
        f"CREATE OR REPLACE TABLE {name} AS "
        f"SELECT DISTINCT * EXCLUDE ({begin}, {until}) FROM {name}"
    )


def _list_times(connection: duckdb.DuckDBPyConnection, names: Sequence[str]) -> list[str]:
    """The tables of times that belong to feature tables."""
    created = {name for (name,) in connection.sql("SHOW TABLES").fetchall()}
    return [f"{name}_times" for name in names if f"{name}_times" in created]


def read_offers(
    log: TypedLog,
    names: Sequence[str],
    store: Path | None,
    grows: bool,
) -> tuple["Offers | None", IntArray | None]:
    """What was on offer in the steps of a log, after `number_ids`; None for everything.

    Items are available as the feature tables `names` say, and items that these lack as in a
    `store`; if it `grows`, sets of candidates follow its own. The second value is the first of
    `number_sets`, if the log has candidates.
    """
    connection, tables = log.connection, _list_times(log.connection, names)
    has_older = store is not None and (store / OFFERS).is_file()
    if not (tables or has_older or schema.CANDIDATES in log.columns):
        return None, None
    from ucfrec.episodes.offers import Offers  # imports torch

    intervals, sets = (np.zeros((rows, 0), dtype=np.int64) for rows in (3, 2))
    begin, until = (f"coalesce({name}, {n})" for name, n in zip(AVAILABLE, ALWAYS, strict=True))
    for name in tables:
        rows = connection.sql(
            f"SELECT number::BIGINT, {begin}, {until} "
            f"FROM items JOIN {name} ON {schema.ITEM_ID} = id"
        ).fetchnumpy()
        intervals = np.hstack([intervals, np.stack([*rows.values()]).astype(np.int64)])
    if store is not None and has_older:
        older = Offers.load(store / OFFERS)
        remaining, sets = older.intervals, older.sets.numpy() if grows else sets
        intervals = np.hstack([intervals, remaining[:, ~np.isin(remaining[0], intervals[0])]])
    numbers, sets = number_sets(log, sets) or (None, sets)
    (n_items,) = log.one("SELECT count(*) FROM items")
    some = intervals.size or sets.size
    return Offers.of(n_items, intervals, sets) if some else None, numbers


def count_features(
    connection: duckdb.DuckDBPyConnection, tables: Sequence[FeatureTable], names: Sequence[str]
) -> dict[str, dict[str, int]]:
    """Of each feature table, how many columns of which kind it has; `names` of `load_features`."""
    kinds = (connection.sql(f"DESCRIBE {name}").fetchall()[1:] for name in names)
    return {
        first_and_more([*map(Path, table.files)]): Counter(_KINDS[kind] for _, kind, *_ in columns)
        for table, columns in zip(tables, kinds, strict=True)
    }


def _select_part(
    connection: duckdb.DuckDBPyConnection,
    opened: Table,
    table: FeatureTable,
    kind: str,
    id_type: str,
    types: dict[str, tuple[str, Path]],
) -> str:
    """SQL of a part's rows: `id`, and its features as `f0`, …, which are added to `types`: name in
    lower case to type and the first file that has it."""
    key = bind(connection, opened, f"key of {kind} features", table.key)
    times = _bind_times(connection, opened, table, kind)
    key_columns = {name.casefold() for bound in (key, *times.values()) for name in bound.columns}
    names = table.columns or tuple(
        name
        for name in opened.columns
        if name.casefold() not in key_columns and not PANDAS_INDEX.fullmatch(name)
    )
    # The text of a CSV file is what its keys are, not what DuckDB makes of it.
    raw = key.columns if key.is_column and not opened.columnar else ()
    if raw:
        key = Bound(quote_name(raw_name(raw[0])), "VARCHAR", (), False)
    id_sql, sources, values, first = _cast_id(key.sql, key.kind, id_type), [key], {}, ""
    for name in names:
        feature, folded = bind(connection, opened, f"{kind} feature", name), name.casefold()
        comparable = _cast_feature(feature.sql, feature.kind)
        if comparable is None:
            remedy = "cast it to a number, text, or a list of either"
            raise wrong_type(opened, f"{kind} feature", name, feature.kind, remedy)
        sql, type_ = comparable
        earlier, file = types.get(folded, (NOTHING, opened.files[0]))
        if earlier == NOTHING:
            types[folded] = type_, opened.files[0]
        elif type_ not in (earlier, NOTHING):
            raise InputError(
                f"{opened.files[0]}: {kind} feature {folded} is {type_} here and {earlier} in "
                f"{file}; write it in one type"
            )
        values[f"f{list(types).index(folded)}"] = sql
        sources.append(feature)
    if table.first_by:
        order = bind(connection, opened, f"first_by of {kind} features", table.first_by)
        sources.append(order)
        # Ties are broken by the features, so that the order of rows does not matter.
        ties = ", ".join([order.sql, *values.values()])
        first = f" QUALIFY row_number() OVER (PARTITION BY {id_sql} ORDER BY {ties}) = 1"
    columns = (column for source in (*sources, *times.values()) for column in source.columns)
    narrow = opened.of(columns, raw)
    for name, time in times.items():
        sql, _ = cast_value(connection, narrow, name, getattr(table, name) or name, time, None)
        has_text = f"trim(CAST({time.sql} AS VARCHAR)) NOT IN ('', 'nan')"
        # Seconds since 1970, read as milliseconds, are of its first weeks.
        faulty = f"{has_text} AND ({sql}) IS NULL OR ({sql}) BETWEEN 100_000_000 AND 4_000_000_000"
        if count := _count(connection, f"{narrow.sql} WHERE {faulty}"):
            remedy = "write ISO 8601, or milliseconds, or nothing for no bound"
            raise InputError(f"{opened.files[0]}: {name} is no time in {count:,} rows; {remedy}")
        values[name] = sql
    features = "".join(f", {sql} AS {name}" for name, sql in values.items())
    return f"SELECT {id_sql} AS id{features} FROM {narrow.sql}{first}"


def _bind_times(
    connection: duckdb.DuckDBPyConnection,
    opened: Table,
    table: FeatureTable,
    kind: str,
) -> dict[str, Bound]:
    """`available_from` and `available_until` of items; a table that has one of them has both."""
    if kind != schema.ITEM_ID:
        return {}
    columns = {name.casefold() for name in opened.columns}
    texts = {name: getattr(table, name) or (name if name in columns else "") for name in AVAILABLE}
    if not any(texts.values()):
        return {}
    return {
        name: bind(connection, opened, f"for {name} of items", text or "CAST(NULL AS TIMESTAMP)")
        for name, text in texts.items()
    }


def _cast_feature(sql: str, kind: str) -> tuple[str, str] | None:
    """SQL of a feature as DOUBLE, VARCHAR, VARCHAR[] or FLOAT[], and that type; None for others."""
    if kind == NOTHING:
        return "NULL", NOTHING
    if is_number(kind):
        # Undefined numbers, such as the logarithm of 0, are missing.
        return f"TRY(CAST({sql} AS DOUBLE))", "DOUBLE"
    if time := cast_timestamp(sql, kind):
        return f"epoch({time}) / 86400", "DOUBLE"
    if kind in ("VARCHAR", "BOOLEAN", "UUID") or kind.startswith("ENUM"):
        return f"CAST({sql} AS VARCHAR)", "VARCHAR"
    if is_vector(kind) and not is_integer(kind.partition("[")[0]):
        return f"CAST({sql} AS FLOAT[])", "FLOAT[]"
    if kind.endswith("]") and "][" not in kind and not kind.startswith(("STRUCT", "MAP")):
        return f"CAST({sql} AS VARCHAR[])", "VARCHAR[]"
    return None


def _cast_id(key: str, key_type: str, id_type: str) -> str:
    if is_number(key_type) and not is_integer(key_type):
        # 12.0 is the text '12' and no other; a cast of 12.4 would round it to another id, as the
        # file did with whole numbers that its type does not hold.
        exact = f"AND abs({key}) < {WHOLE[key_type]}" if key_type in WHOLE else ""
        key = f"CASE WHEN {key} = trunc({key}) {exact} THEN TRY_CAST({key} AS HUGEINT) END"
    elif id_type == "BIGINT" and not is_integer(key_type):
        return cast_integer(key)
    as_id = f"TRY_CAST({key} AS {id_type})"
    # Text without a character is missing, as in the log.
    return as_id if id_type == "BIGINT" else f"nullif({as_id}, '')"


def feature_digest(connection: duckdb.DuckDBPyConnection, names: Sequence[str]) -> str:
    """A digest of every id and value of feature tables, in whatever order their rows are."""
    digest = hashlib.sha256()
    for name in [*names, *_list_times(connection, names)]:
        columns = connection.sql(f"DESCRIBE {name}").fetchall()
        digest.update(repr([column[:2] for column in columns]).encode())
        rows = connection.sql(f"SELECT * FROM {name} ORDER BY ALL")
        for batch in rows.to_arrow_reader(BATCH_ROWS):
            for column in batch.columns:
                if str(column.type) == "double":
                    values = np.asarray(column.fill_null(np.nan))
                    digest.update(np.where(np.isnan(values), np.nan, values).tobytes())
                else:
                    digest.update("\n".join(map(repr, column.to_pylist())).encode())
    return digest.hexdigest()


def require_known_ids(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    names: Sequence[str],
    kind: str,
    noted: bool,
) -> None:
    """Raise InputError if a feature table has no row of an id of the log; if `noted`, warn if many
    ids have none. `names` and `kind` are those of `load_features`."""
    used_ids = next(f"used_{table}" for name, table, _ in ID_TABLES if name == kind)
    for table, name in zip(tables, names, strict=True):
        if not _count(connection, f"{used_ids} SEMI JOIN {name} ON id = {kind}"):
            ids = _list_examples(connection, "id", name)
            keys = f"is {ids}, …" if ids else "is never such an id"
            log_ids = _list_examples(connection, kind, used_ids)
            raise InputError(
                f"{', '.join(map(str, table.files))}: no row belongs to a {kind} of the log, which "
                f"are {log_ids}, …, and {table.key} {keys}; let the key be an "
                "expression that gives the same ids, or leave the file out"
            )
    if noted:
        which = f"{kind}s of the log"
        note_lacking(connection, tables, names, kind, used_ids, which, MANY)


def note_lacking(
    connection: duckdb.DuckDBPyConnection,
    tables: Sequence[FeatureTable],
    names: Sequence[str],
    kind: str,
    rows: str,
    which: str,
    share: float = 0,
) -> None:
    """Warn of ids in rows (SQL; `which` in words), if more than a share have no features."""
    count = _count(connection, rows)
    for table, name in zip(tables, names, strict=True):
        without_row = _count(connection, f"{rows} ANTI JOIN {name} ON id = {kind}")
        if without_row > share * count:
            warn_user(
                f"{', '.join(map(str, table.files))}: {without_row:,} of {count:,} {which} have "
                "no row; their features count as missing"
            )


def _count(connection: duckdb.DuckDBPyConnection, rows: str) -> int:
    ((count,),) = connection.sql(f"SELECT count(*) FROM {rows}").fetchall()
    return int(count)


def _list_examples(connection: duckdb.DuckDBPyConnection, column: str, rows: str) -> str:
    values = connection.sql(f"SELECT {column} FROM {rows} ORDER BY 1 LIMIT 3").fetchall()
    return ", ".join(f"{value!r:.40}" for (value,) in values)


@dataclass(frozen=True)
class EncodedFeatures:
    """What is known of the users and items of a store, by number."""

    items: "sparse.csr_matrix | None"
    """(n_items, F) float32; None without features."""
    users: "sparse.csr_matrix | None"
    """(n_users, G) float32; None without features."""
    item_counts: IntArray
    """(n_items,) training steps that show each."""
    user_counts: IntArray
    """(n_users,) training steps of each."""
    tags: IntArray
    """(n_items, T) tags, padded with −1; T is 0 without any."""


def encode_ids(
    connection: duckdb.DuckDBPyConnection, names: Mapping[str, Sequence[str]]
) -> EncodedFeatures:
    """Encode the features of all users and items, by id column the tables of `load_features`."""
    features, counts = {}, {}
    for name, table, _ in ID_TABLES:
        features[name] = encode_features(connection, names[name], table, name)
        rows = connection.sql(f"SELECT train_count FROM {table} ORDER BY number").fetchnumpy()
        counts[name] = rows["train_count"].astype(np.int64)
    items, users = schema.ITEM_ID, schema.USER_ID
    tags = item_tags(connection, names[items], len(counts[items]))
    return EncodedFeatures(features[items], features[users], counts[items], counts[users], tags)


def encode_features(
    connection: duckdb.DuckDBPyConnection,
    names: Sequence[str],
    ids: str,
    id_column: str,
) -> "sparse.csr_matrix | None":
    """(n_ids, F) float32 features, row i of the id with `number` i in the table `ids`, or None.

    Numbers are standardised and clipped, 0 where missing; categories and tags are one-hot. Means,
    deviations and the kept categories are of training rows. InputError if vectors differ in length.
    """
    from scipy import sparse  # takes a moment to import

    entries, width = [], 0
    for name in names:
        joined = f"{ids} JOIN {name} ON {ids}.{id_column} = {name}.id"
        for column, kind, *_ in connection.sql(f"DESCRIBE {name}").fetchall()[1:]:
            if kind in ("DOUBLE", "FLOAT[]"):
                vector = column if kind == "FLOAT[]" else f"[{column}]"
                values, rows, columns, size = _encode_numbers(connection, joined, column, vector)
            else:
                value = column if kind == "VARCHAR" else f"unnest(list_distinct({column}))"
                cases = f"SELECT number, train_count > 0 AS counts, {value} AS value FROM {joined}"
                rows, columns = _rank_values(connection, cases, CATEGORIES)
                values = np.ones(len(rows), np.float32)
                size = int(columns.max(initial=-1)) + 1
            entries.append((values, rows, columns + width))
            width += size
    if not width:
        return None
    values, rows, columns = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    shape = (_count(connection, ids), width)
    return sparse.coo_matrix((values, (rows, columns)), shape=shape).tocsr()


def _encode_numbers(
    connection: duckdb.DuckDBPyConnection,
    joined: str,
    column: str,
    vector: str,
) -> tuple[Array, IntArray, IntArray, int]:
    """Entries of a matrix: values, rows and columns, of which there are so many."""
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
    values = values.reshape(-1, sizes[0][0] if sizes else 1)
    numbers, training = rows["number"].to_numpy(), values[rows["trained"].to_numpy().astype(bool)]
    if not len(training):
        return values[:0, 0], numbers[:0], numbers[:0], 0
    deviation = training.std(axis=0)
    varied = deviation > 0
    scaled = (values - training.mean(axis=0))[:, varied] / deviation[varied]
    scaled = np.clip(scaled, -CLIP, CLIP).astype(np.float32)
    size = scaled.shape[1]
    columns = np.tile(np.arange(size), len(numbers))
    return scaled.ravel(), np.repeat(numbers, size), columns, size


def _rank_values(
    connection: duckdb.DuckDBPyConnection, cases: str, most: int
) -> tuple[IntArray, IntArray]:
    """The `number` of cases (SQL), in order, that have one of the most frequent values, at most
    `most`, and the rank of the value, from 0 on; frequent where `counts` is true."""
    rows = connection.sql(f"""
        WITH cases AS ({cases}),
        ranked AS (
            SELECT value, row_number() OVER (ORDER BY count(*) DESC, value) - 1 AS rank
            FROM cases WHERE counts AND value IS NOT NULL GROUP BY value ORDER BY rank LIMIT {most}
        )
        SELECT number, rank FROM cases JOIN ranked USING (value) ORDER BY number, rank
    """).fetchnumpy()
    return rows["number"].astype(np.int64), rows["rank"].astype(np.int64)


def item_tags(
    connection: duckdb.DuckDBPyConnection, names: Sequence[str], n_items: int
) -> IntArray:
    """(n_items, T) numbers of tags, padded with −1, T at most `TAGS_PER_ITEM` and 0 without tags.

    Tags are the values of all columns of lists; only the `DISTINCT_TAGS` most frequent ones count.
    An item without any shares none.
    """
    cases = [
        f"SELECT number, true AS counts, '{name}.{column}:' || unnest(list_distinct({column})) "
        f"AS value FROM items JOIN {name} ON items.{schema.ITEM_ID} = {name}.id"
        for name in names
        for column, kind, *_ in connection.sql(f"DESCRIBE {name}").fetchall()[1:]
        if kind == "VARCHAR[]"
    ]
    if not cases:
        return np.zeros((n_items, 0), dtype=np.int64)
    numbers, ranks = _rank_values(connection, " UNION ALL ".join(cases), DISTINCT_TAGS)
    places = np.arange(len(numbers)) - np.searchsorted(numbers, numbers)
    size = min(int(places.max(initial=-1)) + 1, TAGS_PER_ITEM)
    tags, fits = np.full((n_items, size), -1, dtype=np.int64), places < size
    tags[numbers[fits], places[fits]] = ranks[fits]
    return tags
