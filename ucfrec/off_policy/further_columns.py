"""Further columns of logs, beside what a policy was trained on: measures, and groups."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd

from ucfrec import schema
from ucfrec.arrays import Array, Float64Array, IntArray
from ucfrec.episodes.store import EpisodeStore
from ucfrec.errors import InputError, InputNote
from ucfrec.files.atomic import scratch_folder
from ucfrec.logs.engine import bind, engine, explain_errors, text_of_column
from ucfrec.logs.expressions import Expression
from ucfrec.logs.mapping import LogMapping, log_files
from ucfrec.logs.prepare import PrepareOptions, feature_tables, prepare
from ucfrec.logs.tables import Table, open_tables
from ucfrec.logs.typed import open_log_tables
from ucfrec.off_policy.guardrails import Groups

MOST_GROUPS = 20


def read_measure(
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    run: Path,
    keep_unknown: bool,
    measure: str,
    store: EpisodeStore,
) -> Float64Array:
    """(N,) values of an expression at the steps of a `store` that was prepared from logs with these
    options; InputError if other rows have one."""
    options = replace(options, reward=Expression(measure, "--guardrail"))
    with scratch_folder(store.path.parent, "measure") as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore", InputNote)
        prepare(files, mapping, scratch / "store", options, run, keep_unknown)
        values = EpisodeStore.open(scratch / "store")
        rows = (schema.ITEM, schema.TIMESTAMP)
        if not all(np.array_equal(values.column(row), store.column(row)) for row in rows):
            raise InputError(
                f"{files[0]}: --guardrail {measure} has a value in {values.n_steps:,} rows, the "
                f"reward in {store.n_steps:,}, which are not the same; give a default, such as "
                f"coalesce({measure}, 0)"
            )
        return values.column(schema.REWARD).astype(np.float64)


def read_groups(
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    column: str,
    ids: dict[str, tuple[Array, IntArray]],
) -> Groups:
    """Groups by a column of a feature table, or by one of the logs that has one value per user, or
    per item. `ids` of USER_ID and ITEM_ID are (n,) the ids, and (N,) the place there of each
    step's. InputError if there is no such column, or it has too many values, or several per id.
    """
    folder = options.temp_folder or files[0].parent
    parts = (part for tables in feature_tables(mapping).values() for part in tables)
    inputs = [*files, *(file for part in parts for file in log_files(part.files))]
    with engine(inputs, folder, options.memory_limit) as connection:
        for key, tables in _find_tables(connection, files, mapping, options, column):
            with explain_errors(connection, [table for table, _ in tables]):
                pairs = [_read_values(connection, t, id_, key, column) for t, id_ in tables]
            values = pd.concat(pairs).drop_duplicates()
            if values["id"].is_unique:
                break
        else:
            raise InputError(f"{files[0]}: --by {column}: users and items have several values")
    id_values, place = ids[key]
    texts = pd.Series(id_values.tolist(), dtype=object).astype(str)
    names = texts.map(values.set_index("id")["value"]).reindex(place)
    sizes = names.value_counts()
    if not 0 < len(sizes) <= MOST_GROUPS:
        raise InputError(
            f"--by {column} has {len(sizes):,} values in these logs; name a column of 1 to "
            f"{MOST_GROUPS} values"
        )
    number = pd.Categorical(names, categories=sizes.index).codes.astype(np.int64)
    return Groups(tuple(sizes.index), number, key == schema.ITEM_ID)


def _find_tables(
    connection: duckdb.DuckDBPyConnection,
    files: Sequence[Path],
    mapping: LogMapping,
    options: PrepareOptions,
    column: str,
) -> Iterator[tuple[str, list[tuple[Table, str]]]]:
    """Id column and the tables that may have a value for each id, with what the id is there."""
    for key, features in feature_tables(mapping).items():
        opened = [
            (table, part.key)
            for part in features
            for table in open_tables(connection, log_files(part.files))
        ]
        if tables := [pair for pair in opened if column in pair[0].columns]:
            yield key, tables
            return
    log = open_log_tables(connection, files, mapping, options.reward or "0", options.session_by)
    for key in (schema.USER_ID, schema.ITEM_ID):
        yield key, [(t, text_of_column(connection, t, log.mapping, key)) for t in log.tables]


def _read_values(
    connection: duckdb.DuckDBPyConnection, table: Table, id_: str, key: str, column: str
) -> pd.DataFrame:
    """The different pairs of an id and a value of the column, as texts."""
    bound, by = bind(connection, table, key, id_), bind(connection, table, "--by", column)
    texts = bound.columns if bound.is_column else ()
    text = table.text_of(texts[0]) if texts else f"CAST({bound.sql} AS VARCHAR)"
    source = table.add_texts([*bound.columns, *by.columns], texts).sql
    pairs = f"SELECT DISTINCT {text} AS id, CAST({by.sql} AS VARCHAR) AS value FROM {source}"
    return connection.execute(f"FROM ({pairs}) WHERE id IS NOT NULL AND value IS NOT NULL").df()
